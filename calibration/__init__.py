"""From a session's raw frames to a look-up table: registration, radiometry, sampling."""

"""The experiment as data: chart, illuminants, settings, session folder, and measurements of one frame."""

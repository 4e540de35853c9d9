"""Taking a session: devices opened, frames taken in order, judged, and imported from elsewhere."""

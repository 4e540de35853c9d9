"""Take a session: plan, devices, frames, retries, notices; and import of raw files taken by other means."""

"""Take a session: plan, devices, frames, retries and notices. Import raw files that were taken by other means."""

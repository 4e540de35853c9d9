"""The commands under `evaluate`, one file each: parse, build, call, print."""

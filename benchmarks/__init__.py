"""What each part costs: `python -m benchmarks.NAME` prints one JSON object a line for each figure."""

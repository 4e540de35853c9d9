"""What a frame shows, judged as it is taken: the light, the chart, the exposure."""

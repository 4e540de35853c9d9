"""What makes photographs differ beside scene and light: exposure, uneven light, the noise of another ISO speed."""

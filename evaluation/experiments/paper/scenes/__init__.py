"""The scenes of the experiments: pictures from raw images, images generated in memory, ground truths of real data."""

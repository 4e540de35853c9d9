"""From a look-up table and any picture to raw linear images and whole datasets."""

"""What generated data are worth: methods trained on them and tested on real images, beside what they are held to."""

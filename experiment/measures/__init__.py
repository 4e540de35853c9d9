"""What counts say of the sensor, the light and the print: fits, smooth fields, linearity, stains."""

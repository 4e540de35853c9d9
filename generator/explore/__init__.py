"""The LUT explorer: illuminants and rendered pictures in the browser, with the command for each."""

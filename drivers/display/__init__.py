"""What shows a plain colour: full-screen windows and projectors that paint a colour by themselves."""

"""Methods that find pixels of grey surfaces by their derivatives, and take the light from their mean colour."""

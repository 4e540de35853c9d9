"""What was measured, as frozen values: no file is read here, nothing is judged, nothing is drawn."""

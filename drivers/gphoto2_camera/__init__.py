"""Any tethered camera that libgphoto2 supports."""

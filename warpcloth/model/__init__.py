"""What is built from a scene on a device."""

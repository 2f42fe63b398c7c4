"""Contact on a device: the motion of colliders, anchors of friction, contact of cloth with itself, and the filters of steps."""

"""Contact on a device: motion of colliders, anchors of friction, self-contact, and the filters of steps."""

"""Contact on a device: the motion of colliders, anchors of friction, and the filter that ends each step."""

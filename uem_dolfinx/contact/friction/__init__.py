"""Friction: stick and slip in the tangent plane, Q, anchors, limits and wear."""

"""From the motion of the skeleton to the motion of the surface."""

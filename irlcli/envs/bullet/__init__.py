"""What the PyBullet robots of the paper's Sec. 5.2 share.

Each robot is built from data, and bodies that fixed joints connect in the original MJCF file are
merged. Units are metres, radians, kilograms, newtons and newton metres unless a docstring states
another.
"""

"""What the PyBullet robots of the paper's Sec. 5.2 share.

Each robot has two models: ``"merged"``, built from data with every fixed joint merged away, and
``"original"``, the MJCF file of ``pybullet_data``. Units are metres, radians, kilograms, newtons
and newton metres unless a docstring states another.
"""

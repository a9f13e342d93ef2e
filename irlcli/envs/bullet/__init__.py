"""What the PyBullet robots of the paper's Sec. 5.2 share.

Each robot comes as two models: ``"merged"``, built from data with every fixed joint merged
away, and ``"original"``, the MJCF file of ``pybullet_data``. Lengths are metres, angles
radians, masses kilograms, forces newtons and torques newton metres unless said otherwise.
"""

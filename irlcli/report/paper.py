"""Table 1 of "Learning Invariant Reward Functions through Trajectory Interventions" (2021).

Means and standard deviations over random seeds. The paper does not print n. With n = 5, Student's
test reproduces its p-values, except that the first is printed as .0458 instead of .0486.
"""

from typing import NamedTuple

SEEDS = 5


class Printed(NamedTuple):
    """A mean and a standard deviation over seeds."""

    mean: float
    deviation: float


class PrintedRow(NamedTuple):
    """A row of Table 1; ``p_value`` as printed."""

    erm: Printed
    irm: Printed
    expert: Printed
    p_value: float


TABLE1 = {
    ("lunar-lander", "bounce"): PrintedRow(
        Printed(93.1, 30.6), Printed(156.8, 53.1), Printed(230.3, 15.6), 0.0458
    ),
    ("lunar-lander", "engine-power"): PrintedRow(
        Printed(54.3, 64.5), Printed(134.7, 40.2), Printed(204.8, 22.3), 0.0456
    ),
    ("ant", "friction"): PrintedRow(
        Printed(542.7, 114.5), Printed(783.9, 72.4), Printed(1223.2, 187.2), 0.0041
    ),
    ("ant", "leg-length"): PrintedRow(
        Printed(640.7, 87.3), Printed(859.3, 94.1), Printed(1394.6, 154.3), 0.0052
    ),
}

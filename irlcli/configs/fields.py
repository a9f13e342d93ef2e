"""Types of config fields: their bounds, and the names they may have."""

from typing import Annotated, Literal

from msgspec import Meta

# Bounded, so that every count fits 64 bits and no key holds an infinity or NaN.
MAX_COUNT = 2**53
MAX_FLOAT = 1e300
Count = Annotated[int, Meta(ge=1, le=MAX_COUNT)]
NonNegativeCount = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
Positive = Annotated[float, Meta(gt=0, le=MAX_FLOAT)]
NonNegative = Annotated[float, Meta(ge=0, le=MAX_FLOAT)]
Finite = Annotated[float, Meta(ge=-MAX_FLOAT, le=MAX_FLOAT)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
# Below 1, so that something is left.
Dropout = Annotated[float, Meta(ge=0, lt=1)]
Quantile = Annotated[float, Meta(ge=0, le=1, description="a quantile")]
Columns = Annotated[tuple[Annotated[int, Meta(ge=-4096, le=4095)], ...], Meta(max_length=4096)]
Members = Annotated[int, Meta(ge=1, le=1000, description="a whole number")]
# gamma = 1 would make the value of an absorbing state infinite.
Discount = Annotated[float, Meta(ge=0, lt=1)]
# Bounded, so that no description can ask for a network that does not fit memory.
Widths = Annotated[tuple[Annotated[int, Meta(ge=1, le=1024)], ...], Meta(max_length=6)]
Schedule = Literal["constant", "linear"]
Activation = Literal["tanh", "relu"]
Averaged = Literal["rounds", "learning-rate"]
Grouping = Literal["pooled", "balanced", "per-setting", "shuffled"]

"""The methods that the positive controls compare. They are part of keys; importing them loads no torch."""

import msgspec

from irlcli.labels import weight_text

_NAMES = {"pooled": "erm", "balanced": "erm-balanced"}


class MapMethod(msgspec.Struct, frozen=True):
    """A method on cued maps. The first four fields are those of :class:`irlcli.configs.MaxEntConfig`.

    Attributes:
        warm: lambda is zero for the warm-up; otherwise it is there from the start.
        sees: ``all``, or ``texture``: the invariant reward, which a learner cannot know to be it.
    """

    grouping: str = "per-setting"
    penalty: str = "none"
    penalty_weight: float = 0.0
    l2: float = 0.0
    warm: bool = True
    sees: str = "all"

    def __str__(self) -> str:
        """For example ``irmv1-full 100, labels shuffled``."""
        text = _NAMES.get(self.grouping, f"{self.penalty} {weight_text(self.penalty_weight)}")
        text += f" + l2 {weight_text(self.l2)}" if self.l2 else ""
        text += ", labels shuffled" if self.grouping == "shuffled" else ""
        text += "" if self.warm else ", no warm-up"
        return text + (", sees the texture only" if self.sees == "texture" else "")


class LabelMethod(msgspec.Struct, frozen=True):
    """What a classifier adds to the mean risk of the settings.

    Attributes:
        penalty: a key of :data:`irlcli.penalties.PENALTIES` that adversarial learners have.
        weight: lambda.
        shuffled: whether samples are dealt out to the settings at random (the control).
        dropout: share of the hidden units that each step drops.
        oracle: whether it learns from samples whose spurious inputs are permuted.
    """

    penalty: str = "none"
    weight: float = 0.0
    shuffled: bool = False
    dropout: float = 0.0
    oracle: bool = False

    def __str__(self) -> str:
        """For example ``irmv1 100, labels shuffled``."""
        if self.oracle:
            return "oracle"
        if self.dropout:
            return f"dropout {self.dropout:g}"
        if self.penalty == "none":
            return "erm"
        return f"{self.penalty} {weight_text(self.weight)}" + ", labels shuffled" * self.shuffled

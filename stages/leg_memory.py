"""What a vehicle remembers from leg to leg: where it looked in vain, and from where it drove back to look."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Place = tuple[float, float]


@dataclass
class Memory:
    """``looks`` around since the last leg that was driven; ``closed`` places (m) about which unknown ground was looked
    at in vain; ``backs`` places from which it drove back to see what lies before them; ``reopened``: the closed ones
    were tried once more, as the last way that is left."""

    looks: int = 0
    closed: list[Place] = field(default_factory=list)
    backs: list[Place] = field(default_factory=list)
    reopened: bool = False

    def after(
        self, verdict: str, start: Place, length: float, where: Place | None = None
    ) -> Literal["end", "again", "drive"]:
        """What follows a leg (:class:`stages.leg.Leg`): the end, another plan from where it stands, or the drive.

        Parameters
        ----------
        start, length : m; where the leg begins and what of it is driven.
        where : m; place that it closes.
        """
        if verdict == "no path" and self.closed and not self.reopened:
            self.closed, self.looks, self.reopened = [], 0, True
            return "again"
        if verdict in ("goal", "no path"):
            return "end"
        if verdict == "closed":
            if where is None:
                raise ValueError("a leg that closes a place must say where")
            self.closed, self.looks = [*self.closed, where], 0
            return "again"
        self.looks = {"drive": 0, "turn": self.looks, "look": self.looks + 1}[verdict]
        if verdict == "look" and length > 0:
            self.backs = [*self.backs, start]
        return "drive"

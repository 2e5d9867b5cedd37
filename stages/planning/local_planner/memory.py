"""What a vehicle remembers from leg to leg: where it stood and looked, and what it looked at in vain."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from rille.stages.planning.local_planner.views import Stand

Place = tuple[float, float]


@dataclass
class PlannerMemory:
    """``looks`` around since the last leg that was driven; ``closed`` places (m) about which unknown ground was looked
    at in vain; ``stands`` from which it has looked; ``reopened``: the closed places were tried once more, as the last
    way that is left."""

    looks: int = 0
    closed: list[Place] = field(default_factory=list)
    stands: list[Stand] = field(default_factory=list)
    reopened: bool = False

    def after(self, verdict: str, stand: Stand, where: Place | None = None) -> Literal["end", "again", "drive"]:
        """What follows a leg (:class:`rille.stages.planning.local_planner.stage.Leg`): the end, another plan from where
        it stands, or the drive.

        Parameters
        ----------
        stand : where the leg begins.
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
        self.stands = [*self.stands, stand]
        return "drive"

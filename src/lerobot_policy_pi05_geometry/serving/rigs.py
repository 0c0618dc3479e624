"""Which robot a request is of, if the checkpoint was trained on data of several rigs (see geometry/calibration.py)."""

from typing import Any

import numpy as np

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry.keys import RIG
from .limits import RequestError

RIG_KEYS = ("rig", RIG)


class Rigs:
    """Which rigs there are to choose from.

    ids: their numbers; none for a checkpoint of one robot. default: the rig of requests that name none.
    """

    def __init__(self, config: PI05GeometryConfig, only: int | None = None) -> None:
        """only: the rig that is served, whoever asks. Raises ValueError for one that the checkpoint does not have."""
        known = [] if config.geometry_source in ("none", "random") else sorted(map(int, config.rigs))
        if config.rig is not None and known:
            known = [config.rig]
        if only is not None and only not in known:
            have = f"the rigs {', '.join(map(str, known))}" if known else "one robot's calibration, without rigs"
            raise ValueError(f"--rig {only} is not in the checkpoint, which has {have}.")
        self.ids = known if only is None else [only]
        self.default = self.ids[0] if len(self.ids) == 1 else None

    def take(self, message: dict[str, Any], before: int | None = None) -> int | None:
        """The rig that a message names, which is taken out of it; else `before`, else the default.

        Raises RequestError for one that is not known.
        """
        given = [message.pop(name) for name in RIG_KEYS if name in message]
        if not given:
            return self.default if before is None else before
        if not self.ids:
            raise RequestError("The request names a rig, but this policy was trained on one robot; leave it out.")
        number = given[0].item() if isinstance(given[0], np.ndarray) and given[0].size == 1 else given[0]
        if len(given) > 1 or type(number) not in (int, float) or number not in self.ids:
            raise RequestError(f"rig must be the number of one rig of this policy: {self._listed}.")
        return int(number)

    def require(self, rig: int | None) -> None:
        """Raise RequestError for a request of no rig, if there are several."""
        if rig is None and self.ids:
            raise RequestError(
                f"This policy was trained on several rigs; say as rig which of them this robot is: {self._listed}."
            )

    @property
    def _listed(self) -> str:
        return ", ".join(map(str, self.ids))

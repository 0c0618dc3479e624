"""Steps and losses from LeRobot's training log."""

from pathlib import Path


def read_log_line(line: str) -> dict | None:
    """Step (as LeRobot rounds it) and loss of a line of LeRobot's training log; None for any other line."""
    if " step:" not in line or " loss:" not in line:
        return None
    fields = dict(entry.split(":", 1) for entry in line.split(" step:", 1)[1].split()[1:] if ":" in entry)
    digits = line.split(" step:", 1)[1].split()[0]
    scale = {"K": 1_000, "M": 1_000_000}.get(digits[-1], 1)
    return {"step": int(float(digits.rstrip("KM")) * scale), "loss": float(fields["loss"])}


class TrainingCurve:
    """Steps and losses of a training from its log lines. If it was started more than once: of its last start.

    every: steps between two lines. LeRobot rounds steps from 1,000 on ("1K"), so lines are counted instead.
    """

    def __init__(self, every: int) -> None:
        self._every, self._rounded = every, 0
        self.steps: list[int] = []
        self.losses: list[float] = []

    def add(self, line: str) -> bool:
        """Add a log line; returns whether it was a training line."""
        point = read_log_line(line)
        if point is None:
            return False
        if point["step"] < self._rounded:
            self.steps, self.losses = [], []
        self._rounded = point["step"]
        self.steps.append(self._every * (len(self.steps) + 1))
        self.losses.append(point["loss"])
        return True


def read_curve(log: Path, every: int) -> dict[str, list]:
    """Training loss of a run from its log. every: steps between two lines."""
    curve = TrainingCurve(every)
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
        curve.add(line)
    return {"step": curve.steps, "loss": curve.losses}

"""LeRobot's training log, read back."""

from pathlib import Path


def read_log_line(line: str) -> dict | None:
    """Step and loss of a line of LeRobot's training log; None for any other line."""
    if " step:" not in line or " loss:" not in line:
        return None
    fields = dict(entry.split(":", 1) for entry in line.split(" step:", 1)[1].split()[1:] if ":" in entry)
    digits = line.split(" step:", 1)[1].split()[0]
    scale = {"K": 1_000, "M": 1_000_000}.get(digits[-1], 1)
    return {"step": int(float(digits.rstrip("KM")) * scale), "loss": float(fields["loss"])}


def read_curve(log: Path) -> dict[str, list[float]]:
    """Training loss of a run, from its log; of its last start, if it was started more than once."""
    curve: dict[str, list[float]] = {"step": [], "loss": []}
    for line in log.read_text().splitlines():
        point = read_log_line(line)
        if point is None:
            continue
        if curve["step"] and point["step"] < curve["step"][-1]:
            curve = {"step": [], "loss": []}
        for name, values in curve.items():
            values.append(point[name])
    return curve

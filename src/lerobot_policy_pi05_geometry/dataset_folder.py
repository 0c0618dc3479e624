"""A dataset's folder, checked before LeRobot opens it: LeRobot would look for a missing one on the hub."""

from pathlib import Path

INFO_FILE = Path("meta") / "info.json"


def require_dataset(root: Path) -> Path:
    """The folder itself. Raises FileNotFoundError if it holds no LeRobotDataset."""
    if not (root / INFO_FILE).is_file():
        raise FileNotFoundError(
            f"{root} holds no LeRobotDataset ({INFO_FILE} is missing); give the folder that has meta/ and data/ in it."
        )
    return root

"""Optional packages, and how to install them."""

import importlib.util


def require_extra(extra: str, *modules: str) -> None:
    """Raise ModuleNotFoundError, with what to install, unless these modules are there."""
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    if missing:
        raise ModuleNotFoundError(
            f"This needs {', '.join(missing)}; install it with `pip install 'lerobot_policy_pi05_geometry[{extra}]'`."
        )

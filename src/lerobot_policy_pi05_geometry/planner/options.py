"""The user's `--policy.*` and `--peft.*` options as a configuration and a rank, and Depth Anything 3's size from its name."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import draccus
import yaml
from lerobot.configs import PreTrainedConfig

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry.da3 import VARIANTS, Da3Variant
from ..geometry.da3.weights import read_variant
from ..weight_files.files import require_policy_type

_PREFIX, _PEFT = "--policy.", "--peft."
_PEFT_RANK, _PEFT_METHOD, _PEFT_SCALE = "r", "method_type", "lora_alpha"


def lora_rank(arguments: Sequence[str]) -> tuple[int | None, list[str]]:
    """The rank that `--peft.*` options ask for, None without one, and the other arguments. Raises ValueError."""
    given = {}
    for argument in arguments:
        name, separator, value = argument.removeprefix(_PEFT).partition("=")
        if argument.startswith(_PEFT):
            if not separator or name not in (_PEFT_RANK, _PEFT_METHOD, _PEFT_SCALE):
                raise ValueError(f"'{argument}' cannot be planned; of PEFT the planner knows --peft.r=RANK.")
            given[name] = value
    if not given:
        return None, list(arguments)
    if given.get(_PEFT_METHOD, "LORA").upper() != "LORA":
        raise ValueError(f"The planner knows --peft.method_type=LORA only, got '{given[_PEFT_METHOD]}'.")
    rank = given.get(_PEFT_RANK, "16")
    if not rank.isdecimal() or int(rank) < 1:
        raise ValueError(f"--peft.r must be a whole number from 1 on, got '{rank}'.")
    return int(rank), [argument for argument in arguments if not argument.startswith(_PEFT)]


def policy_options(arguments: Sequence[str]) -> dict[str, str]:
    """`--policy.name=value` as name and text. Raises ValueError for anything else, and for unknown names."""
    known = {entry.name for entry in fields(PI05GeometryConfig)} | {"path", "type"}
    options = {}
    for argument in arguments:
        name, separator, value = argument.removeprefix(_PREFIX).partition("=")
        if not argument.startswith(_PREFIX) or not separator:
            raise ValueError(
                f"'{argument}' is not an option of this command; the policy's settings are {_PREFIX}name=value; see --help."
            )
        if name.partition(".")[0] not in known:
            raise ValueError(
                f"{_PREFIX}{name} is not a setting of this policy; see `PI05GeometryConfig` for all settings."
            )
        options[name] = value
    return options


def configuration(options: Mapping[str, str]) -> PI05GeometryConfig:
    """The configuration these options make, of a checkpoint if one of them is its `path`.

    Raises ValueError or FileNotFoundError, with one sentence.
    """
    given = {name: value for name, value in options.items() if name not in ("path", "type", "device")}
    if options.get("type", "pi05_geometry") != "pi05_geometry":
        raise ValueError(f"The planner knows --policy.type=pi05_geometry only, got '{options['type']}'.")
    arguments = [f"--{name}={value}" for name, value in given.items()] + ["--device=cpu"]
    try:
        if "path" in options:
            require_policy_type(options["path"], "pi05_geometry")
            found = PreTrainedConfig.from_pretrained(options["path"], cli_overrides=arguments)
            assert isinstance(found, PI05GeometryConfig)
            return found
        return draccus.parse(PI05GeometryConfig, args=arguments)
    except (draccus.utils.DecodingError, yaml.YAMLError) as error:
        raise ValueError(f"A setting of the policy cannot be read: {' '.join(str(error).split())}.") from error
    except draccus.ParsingError as error:  # the configuration's own sentence
        raise ValueError(str(error.__cause__ or error)) from error


def typed(options: Mapping[str, str], config: PI05GeometryConfig) -> dict[str, Any]:
    """The values that the options' settings have in the configuration."""
    settings = dict.fromkeys(name.partition(".")[0] for name in options)  # `depth_augmentation.noise` is a part of one
    return {name: getattr(config, name) for name in settings if name not in ("path", "type", "device")}


def da3_variant(encoder: str) -> Da3Variant:
    """The size of an encoder: read from its file, or known by its released name. Raises ValueError for an unknown name."""
    path = Path(encoder)
    if path.exists():
        return read_variant(path if path.is_file() else path / "model.safetensors")
    name = encoder.rsplit("/", 1)[-1].lower().removeprefix("da3").removeprefix("-").replace("metric-", "mono-")
    if name not in VARIANTS:
        known = ", ".join(f"DA3-{variant.upper()}" for variant in VARIANTS if variant != "tiny")
        raise ValueError(f"The planner does not know the size of the encoder '{encoder}'; it knows {known}, and files.")
    return VARIANTS[name]

"""The device that ``--device`` means, the same in every command."""

import os


def warp_device(name: str | None) -> str:
    """The Warp device ``name``; without a name, and for ``auto``, the first GPU, or else the CPU.

    Raises:
        ValueError: The device does not exist here.
    """
    import warp as wp

    _keep_to_warnings()
    try:
        return str(wp.get_device(None if name == "auto" else name))
    except (ValueError, RuntimeError) as error:
        here = ", ".join(map(str, wp.get_devices()))
        raise ValueError(
            f"device is {name!r}; it has to be auto, or of those here: {here}"
        ) from error


def resolve_device(name: str) -> str:
    """The device for Warp and torch.

    ``auto`` is this process's GPU (torchrun), the first, or the CPU.

    Raises:
        ValueError: The device does not exist here.
    """
    import torch

    _keep_to_warnings()
    if name == "auto":
        name = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if torch.cuda.is_available() else "cpu"
    if name == "cuda":
        name = "cuda:0"
    if name == "cpu":
        return name
    index = name.removeprefix("cuda:")
    if not name.startswith("cuda:") or not index.isdigit():
        raise ValueError(f"--device is '{name}'; it has to be auto, cpu, or cuda:N")
    if int(index) >= torch.cuda.device_count():
        raise ValueError(
            f"--device is '{name}', but torch finds {torch.cuda.device_count()} GPUs; use auto or "
            f"cpu"
        )
    return name


def _keep_to_warnings() -> None:
    """Have Warp keep to warnings, unless it was told otherwise.

    It tells of every kernel that it loads.
    """
    import warp as wp

    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING

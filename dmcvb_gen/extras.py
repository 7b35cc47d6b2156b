"""Optional packages: find the line that installs a missing module."""

from __future__ import annotations

EXTRAS = {
    "train": ("torch", "stable_baselines3", "sb3_contrib"),
    "pictures": ("imageio_ffmpeg", "matplotlib"),
    "xarray": ("xarray",),
    "s3": ("s3fs",),
    "gs": ("gcsfs",),
    "hf": ("huggingface_hub", "pyarrow"),
    "hdf5": ("h5py",),
    "minari": ("minari",),
    "lerobot": ("pyarrow",),
    "ray": ("ray",),
    "dino": ("timm",),
}
"""Extra -> the modules that it brings."""
SIMULATOR = ("mujoco", "dm_control", "labmaze", "skfmm", "numba", "scipy", "safetensors", "PIL", "gymnasium")
"""Modules of a whole install that one who only reads may leave out."""
PACKAGES = {
    "stable_baselines3": "stable-baselines3",
    "sb3_contrib": "sb3-contrib",
    "skfmm": "scikit-fmm",
    "dm_control": "dm-control",
    "PIL": "pillow",
    "imageio_ffmpeg": "imageio-ffmpeg",
    "yaml": "PyYAML",
}
"""Module -> its package, if the names differ."""


def install_hint(module: str) -> str | None:
    """Say how to install a missing `module` (or its parent); None for a module that no extra brings."""
    top = module.split(".")[0]
    package = PACKAGES.get(top, top)
    extras = [f"[{extra}]" for extra, modules in EXTRAS.items() if top in modules]
    if extras:
        bringing = f"the extra {' or '.join(extras)}"
        return f"this needs {package}, which is not installed: pip install {package} (or {bringing})"
    if top == "labmaze":
        return "mazes need labmaze, which has wheels for Python 3.11 and 3.12 only: use one of these, or another task"
    if top in SIMULATOR or top in PACKAGES:
        return f"this needs {package}, which is not installed: pip install {package} (a whole install brings it)"
    return None

"""MJCF import: the joint screws of an arm that MuJoCo reads."""

import os
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.records import FloatArray, InputError
from projservo_cli.simulation.urdf import arm_screws, joint_screw, listed


def mujoco() -> Any:
    """The module of MuJoCo, which draws without a display if there is none.

    Raises InputError, with what to install, if it is missing or too old.
    """
    if "mujoco" not in sys.modules and sys.platform == "linux":
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco as module
    except ImportError as error:
        what = "too old or broken" if "mujoco" not in str(error.name) else "missing"
        raise InputError(f"MuJoCo is {what}: pip install '.[mujoco]' ({error})") from error
    except AttributeError as error:  # MuJoCo up to 3 looks for the library of GL where it is imported
        raise InputError(no_gl(error)) from error
    if tuple(map(int, module.__version__.split(".")[:2])) < (3, 7):
        raise InputError(f"MuJoCo {module.__version__} is older than 3.7: pip install -U '.[mujoco]'")
    return module


def no_gl(error: BaseException) -> str:
    """Return the packages to install if rendering fails."""
    reason = " ".join(str(error).split())
    return (
        "MuJoCo finds no OpenGL to draw with: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri, "
        f"MUJOCO_GL=egl ({type(error).__name__}: {reason:.120})"
    )


def spec_of(path: str) -> Any:
    """The specification in an MJCF file; an InputError in one line if there is none."""
    try:
        return mujoco().MjSpec.from_file(path)
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot read it: {_line(error)}") from error


def compiled(spec: Any, path: str) -> Any:
    """The model of a specification; an InputError in one line if it is none."""
    try:
        return spec.compile()
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot compile it: {_line(error)}") from error


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:300]


def tip_of(model: Any, tip: str, where: str) -> tuple[int, FloatArray]:
    """Body of a compiled MJCF that holds a tip, by its number, and the pose (4, 4) of the tip in it, m.

    tip : a body, or a site on one. Raises InputError if there is none of this name.
    """
    mj, pose = mujoco(), np.eye(4)
    body = int(mj.mj_name2id(model, mj.mjtObj.mjOBJ_BODY, tip))
    if body > 0:
        return body, pose
    site = int(mj.mj_name2id(model, mj.mjtObj.mjOBJ_SITE, tip))
    if site < 0:
        bodies = listed([model.body(i).name for i in range(1, model.nbody)])
        sites = listed([model.site(i).name for i in range(model.nsite)])
        raise InputError(f"{where}: there is no body {tip}; bodies: {bodies}; sites: {sites or 'none'}")
    pose[:3, :3] = Rotation.from_quat(model.site_quat[site], scalar_first=True).as_matrix()
    pose[:3, 3] = model.site_pos[site]
    return int(model.site_bodyid[site]), pose


def chain_of(model: Any, body: int, where: str) -> list[int]:
    """Joints of a compiled MJCF from its base to a body, by their numbers.

    Raises InputError if no joint moves it, or one neither turns nor slides.
    """
    mj, body_name = mujoco(), model.body(body).name
    chain: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        chain[:0] = range(first, first + int(model.body_jntnum[body]))
        body = int(model.body_parentid[body])
    for joint in chain:
        if mj.mjtJoint(int(model.jnt_type[joint])) not in (mj.mjtJoint.mjJNT_HINGE, mj.mjtJoint.mjJNT_SLIDE):
            name = model.joint(joint).name or joint
            raise InputError(f"{where}: joint {name}, on the chain to {body_name}, has more than one axis")
    if not chain:
        raise InputError(f"{where}: no joint moves body {body_name}")
    return chain


def read_mjcf(path: str, tip: str) -> dict[str, Any]:
    """Screws of the joints of an MJCF file from its base to a body or site, as ``robot.screws`` takes them.

    Raises InputError as of ``tip_of`` and ``chain_of``, or if there is no such file.
    """
    mj = mujoco()
    model = compiled(spec_of(path), path)
    body, held = tip_of(model, tip, path)
    chain, data = chain_of(model, body, path), mj.MjData(model)
    mj.mj_kinematics(model, data)
    joints = []
    for i in chain:
        slides = mj.mjtJoint(int(model.jnt_type[i])) == mj.mjtJoint.mjJNT_SLIDE
        limits = model.jnt_range[i] if model.jnt_limited[i] else None
        kind = "P" if slides else "R"
        joints.append(joint_screw(kind, model.joint(i).name, data.xaxis[i], data.xanchor[i], limits))
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return arm_screws(joints, model.qpos0[model.jnt_qposadr[chain]], tool @ held)


def files_named(path: str) -> list[str]:
    """Return the files that an MJCF file names, and those that these name: parts of it, meshes, textures.

    Names are relative to the folder of the model, or to one of the folders of its compiler settings.
    """
    home, named, due = Path(path).parent, dict[str, None](), [Path(path)]
    folders = [home]
    while due:
        try:
            elements = list(ET.parse(due.pop()).getroot().iter())
        except (OSError, ET.ParseError):  # MuJoCo reports it
            continue
        subfolders = [
            element.get(key) for element in elements for key in ("assetdir", "meshdir", "texturedir")
        ]
        folders += [home / folder for folder in subfolders if folder]
        for element in elements:
            for name in (value for key, value in element.items() if key.startswith("file")):
                files = (folder / part for folder in folders for part in (name, Path(name).name))
                file = next((file for file in files if file.is_file()), None)
                if file is not None and str(file) not in named:
                    named[str(file)] = None
                    due += [file] if file.suffix == ".xml" else []
    return list(named)

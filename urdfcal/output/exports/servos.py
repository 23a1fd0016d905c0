"""MuJoCo: position servos that yield as the joints of a calibrated arm do.

A servo of gain K on a joint holds it with the torque g K (u - g q), g the transmission's gear and u the control. Where
gravity's torque is G, the joint rests at u / g - G / (g^2 K): with K = 1 / (g^2 c) it yields by c G, as a joint of
compliance c does. The control is then what the encoder reads, ``qpos`` where the joint is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import RobotError
from urdfcal.output.exports.mjcf import compiled
from urdfcal.robot.urdf.markup import Edit, Element, ElementReader, apply_edits, changed_attributes

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from urdfcal.result.calibration import Calibration

# A compliance is there that is more than so many standard deviations.
_SURE = 2.0


def yielding_servos(calibration: Calibration, data: bytes, path: Path) -> tuple[bytes, Mapping[str, float]]:
    """Give position servos of a MuJoCo file the gains at which joints yield as they were found to.

    Args:
        calibration: the result.
        data: the file's bytes.
        path: where it finds its meshes, and what to call it in messages.

    Returns:
        The new bytes, and by joint the stiffness against its torque. [N m/rad or N/m]

    Raises:
        RobotError: no joint yields to gravity, or one that does has no position servo.
    """
    entries = calibration.document.joint_models
    found = {joint: of["compliance"] for joint, of in entries.items() if "compliance" in of}
    # One within its noise may come out negative or next to nothing: such a joint stays as stiff as the file has it.
    yields = {joint: of.values[0] for joint, of in found.items() if of.values[0] > _SURE * (of.sigma[0] or np.inf)}
    if not yields or calibration.joint_models.masses is None:
        raise RobotError(
            "no joint was found to yield under the arm's weight",
            where="--servos",
            remedy="Leave the option out: the file's servos stay as they are.",
        )
    model, elements = compiled(data, path), _Actuators.of(data, str(path))
    if len(elements) != model.nu:
        raise RobotError(
            f"{len(elements)} actuators are written out, MuJoCo makes {model.nu} of them",
            where=str(path),
            remedy="Write them out, without <replicate> or <attach>.",
        )
    edits: list[Edit] = []
    stiffness = {}
    for joint, c in yields.items():
        servos = [k for k in range(model.nu) if _is_servo(model, k) and _joint_of(model, k) == joint]
        if len(servos) != 1:
            raise RobotError(
                f"joint {joint!r} yields by {c:.1e}, and has {len(servos)} position servos",
                where=str(path),
                remedy=f'Give it one: <actuator><position joint="{joint}"/></actuator>.',
            )
        (k,) = servos
        gain = 1.0 / (c * model.actuator_gear[k, 0] ** 2)
        values = {"kp": f"{gain:.6g}".encode()}
        if elements[k].tag == "general":
            damping = model.actuator_biasprm[k, 2]
            values = {"gainprm": f"{gain:.6g}".encode(), "biasprm": f"0 {-gain:.6g} {damping:.6g}".encode()}
        edits += changed_attributes(data, elements[k], values)
        stiffness[joint] = 1.0 / c
    return apply_edits(data, edits), stiffness


def _joint_of(model: Any, k: int) -> str:
    """The joint that an actuator moves; of others nothing."""
    import mujoco

    moves = mujoco.mjtTrn(int(model.actuator_trntype[k])) == mujoco.mjtTrn.mjTRN_JOINT
    name: str = model.joint(int(model.actuator_trnid[k, 0])).name if moves else ""
    return name


def _is_servo(model: Any, k: int) -> bool:
    """Whether an actuator's force is a gain times what lacks to its control, less its damping."""
    import mujoco

    gain, bias = model.actuator_gainprm[k], model.actuator_biasprm[k]
    kinds = mujoco.mjtGain(int(model.actuator_gaintype[k])), mujoco.mjtBias(int(model.actuator_biastype[k]))
    fixed = kinds == (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE)
    return bool(fixed and gain[0] > 0.0 and np.isclose(bias[1], -gain[0]) and bias[0] == 0.0)


class _Actuators(ElementReader):
    """Gathers the actuators, in the order that MuJoCo numbers them."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.found: list[Element] = []

    @classmethod
    def of(cls, data: bytes, path: str) -> list[Element]:
        reader = cls(path)
        reader.read(data)
        return reader.found

    def started(self, element: Element) -> None:
        if [of.tag for of in self.opened] == ["mujoco", "actuator"]:
            self.found.append(element)

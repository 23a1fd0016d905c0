"""Xacro: the calibrated origins as a table that a description's source can read."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from urdfcal.result.calibration import Calibration

FILE = "origins.yaml"

_INSTRUCTION = """\
# Calibrated joint origins, m and rad; calibration.json has sha256 {sha256}.
# In the xacro file, once:
#   <xacro:property name="calibrated" value="${{xacro.load_yaml('{file}')}}"/>
# In each joint below, instead of its <origin>:
#   <origin xyz="${{calibrated['{joint}']['xyz']}}" rpy="${{calibrated['{joint}']['rpy']}}"/>
# Or leave the xacro file alone, and correct what it expands to: urdfcal apply OUT robot.urdf
"""


def xacro_patch(calibration: Calibration) -> dict[str, str]:
    """Write the origins, in the parent link's frame, with the instruction how to use them above.

    Args:
        calibration: the result.

    Returns:
        The file, by name.
    """
    import yaml

    origins = {
        joint: {key: " ".join(repr(float(value)) for value in T[key]) for key in ("xyz", "rpy")}
        for joint, T in calibration.to_dict()["placements"].items()
    }
    instruction = _INSTRUCTION.format(sha256=calibration.sha256, file=FILE, joint=calibration.chain.names[-1])
    return {FILE: instruction + yaml.safe_dump(origins, sort_keys=False, allow_unicode=True, width=200)}

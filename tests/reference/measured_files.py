"""Small measured files, written by hand, and what is read of them."""

import numpy as np

from jaxtrachea.measurements.read import Curve, ReadOptions, read_measurements

TIDY = """\
# a comment
specimen,trial,s [mm],phi [deg],displacement [mm],force [mN],sigma [mN],joint_3 [um],joint_7 [um]
T01,1,35,0,0,0,10,0,
T01,1,35,0,1,500,10,100,20
T01,1,35,0,2,1200,10,210,nan
T02,a,40,90,0,0,5,0,0
T02,a,40,90,0.5,300,5,7,8
"""


def put(folder, text, name="study.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding) if isinstance(text, str) else text)
    return path


def read(path, **options):
    return read_measurements([path], ReadOptions(**options))


def only_bad(measurements):
    assert measurements.curves == ()
    (bad,) = measurements.bad
    assert "\n" not in bad.message + bad.cure
    assert bad.cure
    return bad


def curve(specimen="T01", trial="1", **changes):
    fields = {
        "s_c": 35.0,
        "phi_c": 0.5,
        "displacement": np.array([0.0, 1.0, 2.0]),
        "force": np.array([0.0, 0.5, 1.2]),
        "sigma": np.array([0.01, 0.02, 0.03]),
        "joint_rings": np.array([2, 6]),
        "joint_displacement": np.array([[0.0, np.nan], [0.1, 0.02], [0.21, 0.03]]),
        "source": "here",
    }
    return Curve(specimen, trial, **(fields | changes))


def table(rows, header="displacement [mm],force [N]"):
    return "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n"

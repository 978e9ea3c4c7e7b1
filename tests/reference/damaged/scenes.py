"""Damaged scenes, and meshes, clouds and paths that scenes name."""

import functools
import json
import struct

import numpy as np
import trimesh

from damaged.case import Case, flipped
from jaxtrachea import table_1
from jaxtrachea.trachea.tube import make_tube

MATERIAL = """[material]
EI_L = "1.862 N mm^2"
k_M = "0.1 N/mm"
k_1 = "0.3 N/mm"
k_3 = "0.02 N/mm^3"
"""
PRESS = '[path]\ns = "75 mm"\ndisplacement = ["0 mm", "-4 mm", "0 mm"]\n'
LINE = '[path]\nstart = ["75 mm", "19 mm", "0 mm"]\nend = ["75 mm", "16 mm", "0 mm"]\n'
BALL = '[tool]\nshape = "sphere"\nradius = "5 mm"\n'
GOOD = MATERIAL + PRESS
SWEEP = GOOD + "[sweep]\n"
CLOUD = MATERIAL + LINE + '[tool]\nshape = "cloud"\nfile = "cloud.csv"\n'
FOLLOW = MATERIAL + BALL + '[path]\nfile = "path.csv"\n'


def of(text, *says, command="simulate", **files):
    files = {name.replace("_", "."): content for name, content in files.items()}
    return Case(
        ("scene.toml", *says), {"scene.toml": text, **files}, command=(command, "scene.toml")
    )


@functools.lru_cache(maxsize=2)
def tube(kind: str) -> bytes:
    """The surface of a trachea as a file."""
    mesh = make_tube(table_1(), around=9, along=40)
    body = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
    data = body.export(file_type=kind)
    assert isinstance(data, bytes)
    return data


def mesh(kind, change, *says, codes=(2,), keys="larynx = [1.0, 0.0, 0.0]\nunit = 'mm'\n"):
    """A scene in a trachea whose file is spoilt."""
    name = f"mesh.{kind}"
    text = GOOD.replace("75", "70") + f'[trachea]\nfile = "{name}"\n{keys}'

    def make(folder):
        (folder / name).write_bytes(change(tube(kind.lower())))

    return Case(
        ("scene.toml", "trachea.file", name, *says), {"scene.toml": text}, make,
        ("plan", "scene.toml"), codes,
    )  # fmt: skip


def glb(changes, body=b""):
    """A GLB file of a header, its JSON and a body."""
    document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]}
    document |= {"nodes": [{"mesh": 0}], **changes}
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def triangle(count, length=36, kind=5126):
    """A glTF document of `count` vertices in `length` bytes."""
    return {
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}],
        "accessors": [{"bufferView": 0, "componentType": kind, "count": count, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": length}],
        "buffers": [{"byteLength": length}],
    }


def ply(vertices, faces, rest=b""):
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return head.encode() + rest


ONE = np.eye(3, dtype="<f4").tobytes()
SCENES = {
    "cut in a string": of(GOOD[:20], "TOML", "line 2"),
    "cut after the material": of(MATERIAL, "path"),
    "empty": of("", "path", "add a table"),
    "Latin-1": of(b'title = "\xe4"\n' + GOOD.encode(), "UTF-8"),
    "key twice": of(GOOD + 's = "3 mm"', "TOML", "line 9"),
    **{
        f"unknown key in {where or 'the root'}": of(
            text, f"{where}.zz".lstrip("."), "unknown key", command=command
        )
        for where, text, command in [
            ("", GOOD + "[zz]\n", "plan"),
            ("trachea", GOOD + "[trachea]\nzz = 1", "plan"),
            ("trachea.rings", GOOD + '[trachea]\nlength = "9 mm"\nrings = { zz = 1 }', "plan"),
            ("material", MATERIAL + "zz = 1\n" + PRESS, "simulate"),
            ("tool", MATERIAL + LINE + BALL + "zz = 1", "simulate"),
            ("path.0", GOOD + "zz = 1", "plan"),
            ("model", GOOD + "[model]\nzz = 1", "sweep"),
            ("effects", GOOD + "[effects]\nzz = 1", "plan"),
            ("output", GOOD + "[output]\nzz = 1", "simulate"),
            ("sweep", SWEEP + 'depth = "1 mm"\nzz = 1', "sweep"),
        ]
    },
    "k_M in N": of(GOOD.replace("0.1 N/mm", "0.1 N"), "material.k_M", "stiffness"),
    "k_1 zero": of(GOOD.replace("0.3", "0"), "material.k_1", "positive"),
    "k_3 infinite": of(GOOD.replace("0.02", "inf"), "material.k_3", "number"),
    "EI_L missing": of(GOOD.replace("EI_L", "# EI_L"), "material.EI_L", "missing"),
    "EI_L a list": of(GOOD.replace('"1.862 N mm^2"', "[1]"), "material.EI_L"),
    "shape mistyped": of(MATERIAL + LINE + '[tool]\nshape = "ball"', "tool.shape", "'sphere'"),
    "shape without size": of(MATERIAL + LINE + '[tool]\nshape = "box"', "tool", "size"),
    "size of two": of(
        MATERIAL + LINE + '[tool]\nshape = "box"\nsize = ["1 mm", "2 mm"]', "tool.size", "3"
    ),
    "radius zero": of(MATERIAL + LINE + BALL.replace("5", "0"), "tool.radius", "positive"),
    "friction negative": of(MATERIAL + LINE + BALL + "friction = -1", "tool.friction", "0"),
    "friction nan": of(MATERIAL + LINE + BALL + "friction = nan", "tool.friction", "finite"),
    "path a number": of("path = 3\n" + MATERIAL, "path", "list"),
    "path empty": of("path = []\n" + MATERIAL, "path", "1"),
    "path incomplete": of(MATERIAL + '[path]\ns = "75 mm"', "path.0", "displacement"),
    "path without tool": of(MATERIAL + LINE, "path", "[tool]"),
    "press beyond the tube": of(GOOD.replace("75", "200"), "path.0.s", "160"),
    "press behind the rings": of(GOOD + 'phi = "150 deg"', "path.0.phi", "120"),
    "press by a number": of(GOOD.replace('"-4 mm"', "-4"), "path.0.displacement.1", "mm"),
    "steps 10^9": of(GOOD + "steps = 1000000000", "path.0.steps", "100000"),
    "steps one": of(MATERIAL + BALL + LINE + "steps = 1", "path.0.steps", "2"),
    "turned by two angles": of(
        MATERIAL + BALL + LINE + 'rotation = ["1 deg", "2 deg"]', "path.0.rotation", "3"
    ),
    "effect mistyped": of(GOOD + '[effects]\nrings = "bow"', "effects.rings", "'arch2'"),
    "effect without its value": of(GOOD + '[effects]\naxial = "on"', "effects.axial", "EA_L"),
    "dent of 7": of(GOOD + "[effects]\ndent = 7", "effects.dent", "'8'"),
    "pictures maybe": of(GOOD + '[output]\npictures = "no"', "output.pictures", "boolean"),
    "sweep missing": of(GOOD, "sweep", "[sweep]", command="sweep"),
    "sweep without depth": of(SWEEP, "sweep.depth", "missing", command="sweep"),
    "sweep of 10^9": of(
        SWEEP + 'depth = "1 mm"\ns_count = 1000000000', "sweep.s_count", "10000", command="sweep"
    ),
    "sweep behind the rings": of(
        SWEEP + 'depth = "1 mm"\nphi_max = "150 deg"', "sweep.phi_max", "120", command="sweep"
    ),
    "sweep of depth -1": of(SWEEP + 'depth = "-1 mm"', "sweep.depth", "positive", command="plan"),
    "wall of no tube": of(GOOD + '[trachea]\nradius = "0.3 mm"\nwall = "1 mm"', "trachea", "wall"),
    "around 10^9": of(GOOD + "[trachea]\naround = 1000000000", "trachea.around", "2000"),
}
TABLES = {
    "cloud missing": of(CLOUD, "tool.file", "cloud.csv"),
    "cloud empty": of(CLOUD, "tool.file", "cloud.csv", cloud_csv=""),
    "cloud without unit": of(CLOUD, "tool.file", "x [mm]", cloud_csv="x,y,z\n0,0,0\n"),
    "cloud of two columns": of(CLOUD, "tool.file", "'z'", cloud_csv="x [mm],y [mm]\n0,0\n"),
    "cloud in seconds": of(CLOUD, "tool.file", "'s'", cloud_csv="x [s],y [s],z [s]\n0,0,0\n"),
    "cloud of words": of(
        CLOUD, "tool.file", "cloud.csv", cloud_csv="x [mm],y [mm],z [mm]\n0,zero,0\n"
    ),
    "cloud ragged": of(CLOUD, "tool.file", "cloud.csv", cloud_csv="x [mm],y [mm],z [mm]\n0,0\n"),
    "cloud infinite": of(
        CLOUD, "tool.file", "finite", cloud_csv="x [mm],y [mm],z [mm]\n0,0,1e999\n"
    ),
    "cloud header only": of(CLOUD, "tool.file", "rows", cloud_csv="x [mm],y [mm],z [mm]\n"),
    "cloud binary": of(CLOUD, "tool.file", "cloud.csv", cloud_csv=bytes(range(256))),
    "cloud with NUL": of(
        CLOUD, "tool.file", "cloud.csv", cloud_csv="x [mm],y [mm],z [mm]\n0,\0,0\n"
    ),
    "cloud with an endless cell": of(
        CLOUD, "tool.file", "cloud.csv", cloud_csv='x [mm],y [mm],z [mm]\n0,0,"' + "9" * 200_000
    ),
    "path missing": of(FOLLOW, "path.0.file", "path.csv"),
    "path with one word": of(FOLLOW, "path.0.file", "path.csv", path_csv="nothing"),
    "path of nan": of(
        FOLLOW, "path.0.file", "finite", path_csv="x [mm],y [mm],z [mm]\n70,nan,0\n70,16,0\n"
    ),
    "path turned in mm": of(
        FOLLOW, "path.0.file", "rx",
        path_csv="x [mm],y [mm],z [mm],rx [mm]\n70,16,0,0\n70,16,0,0\n",
    ),
}  # fmt: skip
MESHES = {
    "STL empty": mesh("stl", lambda _: b"", "no triangles"),
    "STL text without triangles": mesh("stl", lambda _: b"solid x\nendsolid x\n"),
    **{f"STL cut to {n} bytes": mesh("stl", lambda d, n=n: d[:n]) for n in (10, 80, 84, 100, 5000)},
    "STL of 4 10^9 triangles": mesh("stl", lambda d: d[:80] + b"\xff" * 4 + d[84:]),
    "STL of no triangle": mesh("stl", lambda d: d[:80] + bytes(4)),
    "STL with nan": mesh(
        "stl", lambda d: d[:96] + np.float32(np.nan).tobytes() + d[100:], "not finite"
    ),
    "STL of one point": mesh("stl", lambda d: d[:84] + bytes(len(d) - 84), "one point"),
    "STL in kilometres": mesh("stl", lambda d: d, "'km'", keys="unit = 'km'\n"),
    "STL in newton": mesh("stl", lambda d: d, "'N'", keys="unit = 'N'\n"),
    "STL with a part": mesh("stl", lambda d: d, "'wall'", keys="part = 'wall'\nunit = 'mm'\n"),
    "STL across": mesh("stl", lambda d: d, "larynx", keys="larynx = [0.0, 1.0, 0.0]\nunit = 'mm'"),
    "STL both ends alike": mesh("stl", lambda d: d, "larynx", keys="unit = 'mm'"),
    "STL of noise": mesh("stl", lambda d: d[:84] + flipped(d[84:], 5, 4000)),
    "STL that is a GLB": mesh("stl", lambda _: tube("glb")),
    "GLB empty": mesh("glb", lambda _: b""),
    **{f"GLB cut to {n} bytes": mesh("glb", lambda d, n=n: d[:n]) for n in (4, 12, 20, 300, 2000)},
    "GLB that is an STL": mesh("glb", lambda _: tube("stl")),
    "GLB of version 1": mesh("glb", lambda d: d[:4] + b"\1\0\0\0" + d[8:]),
    "GLB without JSON": mesh("glb", lambda d: d[:16] + b"NONE" + d[20:]),
    "GLB with broken JSON": mesh("glb", lambda d: d[:20] + b"[" + d[21:]),
    "GLB without mesh": mesh("glb", lambda _: glb({})),
    "GLB of one triangle": mesh("glb", lambda _: glb(triangle(3), ONE)),
    "GLB of 10^12 vertices": mesh("glb", lambda _: glb(triangle(10**12), ONE)),
    "GLB of a view of 10^15 bytes": mesh("glb", lambda _: glb(triangle(3, 10**15), ONE)),
    "GLB of vertices of no type": mesh("glb", lambda _: glb(triangle(3, 36, 9), ONE)),
    "GLB in another file": mesh(
        "glb",
        lambda _: glb(triangle(3) | {"buffers": [{"byteLength": 36, "uri": "/dev/zero"}]}, ONE),
    ),
    "PLY of 10^12 vertices": mesh("ply", lambda _: ply(10**12, 1, ONE)),
    "PLY of -3 vertices": mesh("ply", lambda _: ply(-3, 1, ONE)),
    "PLY cut off": mesh("ply", lambda _: ply(3, 1, ONE)),
    "PLY to a vertex that is not there": mesh(
        "ply", lambda _: ply(3, 1, ONE + b"\3" + struct.pack("<3i", 0, 1, 99))
    ),
    "OBJ of words": mesh("stl", lambda _: b"v a b c\nf 1 2 3\n"),
    "no surface format": mesh("stl", lambda _: b"%PDF-1.7\n" + bytes(99)),
}
CASES = SCENES | TABLES | MESHES

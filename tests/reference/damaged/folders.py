"""Paths that lead elsewhere: links, loops, devices, pipes, folders in the place of files."""

import os

from damaged.case import GOOD, OTHER, SPEC, Case
from damaged.scenes import CLOUD, MATERIAL, PRESS

MESH = MATERIAL + PRESS + '[trachea]\nfile = "mesh.stl"\n'


def link(name, target):
    return lambda folder: (folder / name).symlink_to(target)


def only(make, *says, spec=SPEC):
    return Case(("data.files.0", *says), {"spec.toml": spec}, make)


def scene(text, key, make):
    return Case((key,), {"scene.toml": text}, make, ("plan", "scene.toml"))


def spec(make, *says, command="fit"):
    return Case(("spec.toml", *says), {"data.csv": GOOD}, make, (command, "spec.toml"))


def one_file_for_ten(folder):
    for i in range(10):
        (folder / f"d{i}.csv").symlink_to("data.csv")


CASES = {
    "data a link to a folder": only(link("data.csv", "."), "folder"),
    "data a link to nothing": only(link("data.csv", "nothing.csv"), "data.csv"),
    "data a link to itself": only(link("data.csv", "data.csv"), "data.csv"),
    "data a link to a device": only(link("data.csv", "/dev/zero"), "data.csv"),
    "data a device": only(None, "/dev/zero", spec='[data]\nfiles = "/dev/zero"\n'),
    "data a pipe": only(lambda folder: os.mkfifo(folder / "data.csv"), "data.csv"),
    "data a folder": only(lambda folder: (folder / "data.csv").mkdir(), "folder"),
    "data missing": only(None, "data.csv", "--data"),
    "data far above": only(None, spec='[data]\nfiles = "' + "../" * 60 + 'no.csv"\n'),
    "data that cannot be read": Case(
        ("mem", "cannot be read"), {"spec.toml": '[data]\nfiles = "/proc/self/mem"\n'}
    ),
    "data with NUL in the name": only(None, spec='[data]\nfiles = "a\\u0000b.csv"\n'),
    "data with a long name": only(None, "long", spec=f'[data]\nfiles = "{"x" * 5000}"\n'),
    "pattern of nothing": only(None, "*.tsv", spec='[data]\nfiles = "*.tsv"\n'),
    "pattern of many stars": only(
        lambda folder: folder.joinpath(*["a"] * 40).mkdir(parents=True), "no file",
        spec=f'[data]\nfiles = "{"**/" * 9}x.csv"\n',
    ),
    "pattern that is none": only(None, "a**b", spec='[data]\nfiles = "a**b"\n'),
    "links to one file": Case(
        ("T01", "already in", "rename"),
        {"data.csv": GOOD, "spec.toml": '[data]\nfiles = "*.csv"\n'}, one_file_for_ten,
    ),
    "one of two missing": Case(
        ("data.files.1", "god.csv"),
        {"data.csv": OTHER, "spec.toml": '[data]\nfiles = ["data.csv", "god.csv"]\n'},
    ),
    "specification missing": spec(None, "No such file"),
    "specification a folder": spec(lambda folder: (folder / "spec.toml").mkdir(), "directory"),
    "specification a link to itself": spec(link("spec.toml", "spec.toml"), "link"),
    "specification a device": spec(link("spec.toml", "/dev/zero"), "TOML"),
    "specification a pipe": spec(lambda folder: os.mkfifo(folder / "spec.toml"), "TOML"),
    "scene a device": Case(
        ("scene.toml", "TOML"), {}, link("scene.toml", "/dev/zero"), ("simulate", "scene.toml")
    ),
    "mesh a device": scene(MESH, "trachea.file", link("mesh.stl", "/dev/zero")),
    "mesh a pipe": scene(MESH, "trachea.file", lambda folder: os.mkfifo(folder / "mesh.stl")),
    "mesh a folder": scene(MESH, "trachea.file", lambda folder: (folder / "mesh.stl").mkdir()),
    "mesh a link to itself": scene(MESH, "trachea.file", link("mesh.stl", "mesh.stl")),
    "cloud a device": scene(CLOUD, "tool.file", link("cloud.csv", "/dev/zero")),
    "cloud a link to nothing": scene(CLOUD, "tool.file", link("cloud.csv", "nothing")),
}  # fmt: skip

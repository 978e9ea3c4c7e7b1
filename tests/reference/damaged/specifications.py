"""Damaged fit specifications: broken TOML, unknown keys at all levels, wrong types and ranges."""

from damaged.case import GOOD, SPEC, Case

K_1 = SPEC + "[parameters]\nk_1 = "
TUBE = SPEC + '[trachea]\nlength = "160 mm"\nrings = '
EVEN = '{ count = 3, first = "9 mm", last = "99 mm" }'


def of(text, *says, command="fit"):
    return Case(
        ("spec.toml", *says), {"data.csv": GOOD, "spec.toml": text}, command=(command, "spec.toml")
    )


BROKEN = {
    "cut in a string": of(SPEC[:18], "TOML", "line 2"),
    "cut in a key": of(SPEC + "[fit]\nsta", "TOML", "line 4"),
    "cut in a table": of(SPEC + "[trachea", "TOML", "line 3"),
    "cut in a list": of(SPEC + "[fit]\nstarts = [1,", "TOML", "line 4"),
    "empty": of("", "data"),
    "comment only": of("# nothing\n", "data"),
    "key twice": of(SPEC + "files = 'b'", "TOML", "line 3"),
    "table twice": of(SPEC + "[fit]\n[fit]\n", "TOML", "line 4"),
    "value missing": of(SPEC + "[fit]\nstarts =\n", "TOML", "line 4"),
    "no quotes": of("[data]\nfiles = data.csv\n", "TOML", "line 2"),
    "typographic quotes": of("[data]\nfiles = “data.csv”\n", "TOML", "line 2"),
    "colon": of("[data]\nfiles: data.csv\n", "TOML", "line 2"),
    "JSON": of('{"data": {"files": "data.csv"}}', "TOML", "line 1"),
    "backslashes of a path": of('[data]\nfiles = "C:\\Users\\me.csv"\n', "TOML", "line 2"),
    "decimal comma": of(SPEC + "[fit]\ntolerance = 1,5\n", "TOML", "line 4"),
    "UTF-16": of(SPEC.encode("utf-16"), "UTF-8"),
    "Latin-1": of('title = "Tr\xe4chea"\n'.encode("latin-1") + SPEC.encode(), "UTF-8"),
    "byte-order mark": of(b"\xef\xbb\xbf" + SPEC.encode() + b"[x]", "x"),
    "NUL": of(SPEC.replace("data.csv", "data\0.csv"), "TOML", "line 2"),
    "binary": of(bytes(range(256)), "UTF-8"),
    "nested": of(SPEC + "a = " + "[" * 9000, "TOML", "nested"),
    "endless integer": of(SPEC + "[fit]\nseed = " + "9" * 9000, "TOML", "digits"),
    "20 MB": of("#" + "x" * 20_000_000, "bytes"),
    "date of February 30": of(SPEC + "a = 2026-02-30\n", "TOML"),
}
UNKNOWN = {
    f"unknown key in {where or 'the root'}": of(text, f"{where}.zz".lstrip("."), "unknown key")
    for where, text in {
        "": SPEC + "[zz]\na = 1\n",
        "data": SPEC + "zz = 1\n",
        "trachea": SPEC + "[trachea]\nzz = 1\n",
        "trachea.rings": TUBE + EVEN.replace("}", ", zz = 1 }"),
        "model": SPEC + "[model]\nzz = 1\n",
        "parameters.k_1": K_1 + "{ zz = 1 }",
        "noise": SPEC + "[noise]\nzz = 1\n",
        "fit": SPEC + "[fit]\nzz = 1\n",
        "uncertainty": SPEC + "[uncertainty]\nzz = 1\n",
        "design": SPEC + "[design]\nzz = 1\n",
    }.items()
}
WRONG = {
    "sheet of a text file": of(SPEC + 'sheet = "Data"', "data.sheet", "workbook"),
    "position of a million digits": of(SPEC + f's = "{"1" * 10**6}\\nm\\nm"', "s:", "too long"),
    "title a number": of("title = 3\n" + SPEC, "title", "string"),
    "data a list": of("data = [1]", "data", "table"),
    "files a number": of("[data]\nfiles = 7", "data.files", "list"),
    "files of numbers": of("[data]\nfiles = [7]", "data.files.0", "string"),
    "format mistyped": of(SPEC + 'format = "tydi"', "data.format", "tidy"),
    "columns a text": of(SPEC + 'columns = "force"', "data.columns", "table"),
    "column a number": of(SPEC + "columns = { force = 3 }", "data.columns.force", "string"),
    "role unknown": of(SPEC + 'columns = { farce = "F" }', "data", "'farce'", "force"),
    "unit of an unknown role": of(SPEC + 'units = { farce = "N" }', "data", "'farce'"),
    "unit unknown": of(SPEC + 'units = { force = "kip" }', "data: units.force", "'kip'"),
    "s in newton": of(SPEC + 's = "3 N"', "data: s:", "'N'"),
    "s no quantity": of(SPEC + 's = "left"', "data: s:", "'left'"),
    "phi infinite": of(SPEC + 'phi = "inf deg"', "data: phi:"),
    "window in N": of(SPEC + 'displacement_min = "1 N"', "data.displacement_min", "'N'"),
    "window reversed": of(
        SPEC + 'displacement_min = "2 mm"\ndisplacement_max = "1 mm"', "data", "below"
    ),
    "window nan": of(SPEC + 'displacement_min = "nan mm"', "data.displacement_min"),
    "sign 0": of(SPEC + "force_sign = 0", "data.force_sign", "1"),
    "sign a text": of(SPEC + 'force_sign = "-"', "data.force_sign"),
    "loading mistyped": of(SPEC + 'loading = "up"', "data.loading", "'loading'"),
    "pattern broken": of(SPEC + "specimen = '(?P<specimen'", "data", "regular"),
    "pattern without name": of(SPEC + "specimen = '.*'", "data", "specimen"),
    "preset unknown": of(SPEC + '[trachea]\npreset = "rat"', "trachea.preset", "table-1"),
    "length bare": of(SPEC + "[trachea]\nlength = 160\nrings = []", "trachea.length", "160 mm"),
    "length negative": of(
        SPEC + '[trachea]\nlength = "-1 mm"\nrings = ["1 mm"]', "trachea.length", "positive"
    ),
    "radius 1e999": of(SPEC + '[trachea]\nradius = "1e999 mm"', "trachea.radius", "finite"),
    "angle 400 deg": of(SPEC + '[trachea]\nhalf_angle = "400 deg"', "trachea.half_angle"),
    "rings before length": of(SPEC + '[trachea]\nrings = ["1 mm"]', "trachea", "length"),
    "rings not in order": of(TUBE + '["9 mm", "8 mm"]', "trachea.rings", "increasing"),
    "ring twice": of(TUBE + '["9 mm", "9 mm"]', "trachea.rings", "increasing"),
    "rings of another unit": of(TUBE + '["9 mm", "8 N"]', "trachea.rings.1", "'N'"),
    "a billion rings": of(TUBE + EVEN.replace("3", "1000000000"), "trachea.rings.count", "2000"),
    "rings a truth": of(TUBE + "true", "trachea.rings", "list"),
    "coupling mistyped": of(SPEC + '[model]\ncoupling = "serie"', "model.coupling", "'series'"),
    "shear a text": of(SPEC + '[model]\nshear = "on"', "model.shear", "boolean"),
    "onset width zero": of(SPEC + '[model]\nonset_width = "0 mm"', "model.onset_width", "positive"),
    "parameter unknown": of(SPEC + "[parameters]\nk_9 = {}", "parameters.k_9", "k_1"),
    "parameter of another model": of(SPEC + "[parameters]\nGA_L = {}", "parameters.GA_L"),
    "parameter a number": of(K_1 + "3", "parameters.k_1", "table"),
    "initial in mm": of(K_1 + '{ initial = "3 mm" }', "parameters.k_1", "'mm'"),
    "initial a list": of(K_1 + "{ initial = [3] }", "parameters.k_1.initial", "number"),
    "initial outside": of(
        K_1 + "{ initial = 9, bounds = [1, 2] }", "parameters.k_1", "outside its bounds"
    ),
    "initial nan": of(K_1 + "{ initial = nan }", "parameters.k_1", "finite"),
    "bounds reversed": of(K_1 + "{ bounds = [2, 1] }", "parameters.k_1", "below"),
    "bounds of three": of(K_1 + "{ bounds = [1, 2, 3] }", "parameters.k_1.bounds"),
    "bounds infinite": of(K_1 + "{ bounds = [1, inf] }", "parameters.k_1", "finite"),
    "bounds negative": of(K_1 + "{ bounds = [-1, 1] }", "parameters.k_1", "positive"),
    "scale mistyped": of(K_1 + "{ scale = 'ln' }", "parameters.k_1.scale", "'log'"),
    "scope mistyped": of(K_1 + "{ scope = 'all' }", "parameters.k_1.scope", "'shared'"),
    "fixed and free": of(K_1 + "{ fixed = 1, scope = 'shared' }", "parameters.k_1", "excludes"),
    "fixed zero": of(K_1 + "{ fixed = 0 }", "parameters.k_1", "more than 0"),
    "fixed nan": of(K_1 + "{ fixed = nan }", "parameters.k_1"),
    "fixed infinite": of(K_1 + "{ fixed = inf }", "parameters.k_1", "finite"),
    "noise bare": of(SPEC + "[noise]\nforce = 0.1", "noise.force", "0.1 N"),
    "noise zero": of(SPEC + '[noise]\nforce = "0 N"', "noise.force", "positive"),
    "noise mistyped": of(
        SPEC + '[noise]\nforce = "estimated"', "noise.force", "'estimated'", "or 'estimate'"
    ),
    "method mistyped": of(SPEC + '[fit]\nmethod = "lm"', "fit.method", "levenberg"),
    "loss mistyped": of(SPEC + '[fit]\nloss = "l1"', "fit.loss", "'huber'"),
    "loss scale zero": of(SPEC + "[fit]\nloss_scale = 0", "fit.loss_scale", "greater"),
    "batch by its old name": of(SPEC + "[fit]\nchunk = 64", "fit", "'batch'", "rename"),
    "batch 0": of(SPEC + "[fit]\nbatch = 0", "fit.batch: expected 'auto', or a", "from 1"),
    "save every 0": of(SPEC + "[fit]\nsave_every = 0", "fit.save_every: expected 'auto', or a"),
    "starts 0": of(SPEC + "[fit]\nstarts = 0", "fit.starts", "1"),
    "starts 1e9": of(SPEC + "[fit]\nstarts = 1000000000", "fit.starts", "10000"),
    "starts a fraction": of(SPEC + "[fit]\nstarts = 1.5", "fit.starts", "integer"),
    "tolerance 1": of(SPEC + "[fit]\ntolerance = 1", "fit.tolerance", "0.1"),
    "precision 16": of(SPEC + '[fit]\nprecision = "float16"', "fit.precision", "float64"),
    "iterations -1": of(SPEC + "[fit]\nmax_iterations = -1", "fit.max_iterations", "1"),
    "bootstrap 3": of(SPEC + "[uncertainty]\nbootstrap = 3", "uncertainty", "40"),
    "block alone": of(SPEC + "[uncertainty]\nblock = 3", "uncertainty", "residual"),
    "profile unknown": of(SPEC + '[uncertainty]\nprofile = "k_9"', "uncertainty.profile", "k_1"),
    "points 1": of(SPEC + "[uncertainty]\nprofile_points = 1", "uncertainty.profile_points", "2"),
    "design reversed": of(SPEC + '[design]\ns = ["9 mm", "1 mm"]', "design", "swap"),
    "design outside": of(
        SPEC + '[design]\ns = ["9 mm", "900 mm"]', "design.s", "160", command="design"
    ),
    "design of one": of(SPEC + '[design]\ns = ["9 mm"]', "design.s"),
    "criterion mistyped": of(SPEC + '[design]\ncriterion = "G"', "design.criterion", "'D'"),
    "no data": of("[fit]\nstarts = 1", "data", "missing"),
    "nothing free": of(
        K_1 + "{ fixed = 1 }\nk_3 = { fixed = 0 }\nEI_L = { fixed = 1 }\nk_M = { fixed = 1 }\n"
        "[uncertainty]\nbootstrap = 40",
        "no free parameter",
    ),
}
CASES = BROKEN | UNKNOWN | WRONG

"""The page: a scene under the mouse in a real browser, who may ask the server, recordings.

Truth: `simulate` of the same pose; the network log of the browser; the rules of RFC 6454 (origins).
"""

import asyncio
import json
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra 'viewer' is not installed")
from browser import CHROMIUM, Browser
from page_server import Server
from run_cli import run
from websockets.exceptions import ConnectionClosed, InvalidStatus

from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.status import PressStatus
from jaxtrachea.viewer.frame import LONGEST, Frame, Touch, read_pose
from jaxtrachea.viewer.live import Live
from jaxtrachea.viewer.play import PlayError, of_file
from jaxtrachea.viewer.scene import for_a_mouse, read_handled
from jaxtrachea.viewer.values import Slider, with_values

#: Each waits for the page, which compiles for a quarter of a minute.
pytestmark = pytest.mark.long

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
SCENE = """title = "a <short> tube"
[trachea]
length = "60 mm"
rings = { count = 4, first = "12 mm", last = "48 mm" }
around = 24
along = 31
[material]
EI_L = "1.862 N mm^2"
EA_L = "3.9 N"
k_M = "0.1 N/mm"
k_1 = "0.3 N/mm"    # of the wall
k_3 = "0.02 N/mm^3"
[tool]
shape = "sphere"
radius = "5 mm"
[[path]]
start = ["30 mm", "18 mm", "0 mm"]
end = ["30 mm", "16 mm", "0 mm"]
steps = 4
"""
#: Positions of the tool: pressed on and off the midline, clear, behind the ends of the rings.
PLACES = [[30.0, 14.6, 0.0], [21.0, 12.0, 9.5], [30.0, 25.0, 0.0], [30.0, -15.0, 0.0]]
#: Labels there, of `simulate`: a long row holds them to it.
LABELS = ["F 0.1196 N", "F 0.1231 N", "no contact", "no force"]
CONFIGS, REFERENCE = Path(__file__).parents[1] / "configs", Path(__file__).parent / "reference"
FORCE = "document.querySelector('[data-role=force]').innerText"
OTHERS = "document.querySelector('[data-role=others]').innerText"
DETAIL = "document.querySelector('[data-role=detail]').innerText"


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "short.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def simulation(scene_file):
    """simulation.h5 of the places; with `contact_point` per_step each row is by itself."""
    return simulated(scene_file, PLACES)


def simulated(scene, places):
    script, file = REFERENCE / "simulate_places.py", scene.with_name("simulation.h5")
    subprocess.run([sys.executable, script, scene, json.dumps(places), file], check=True)
    return file


@pytest.fixture(scope="module")
def server(scene_file):
    """`view` of the scene."""
    made = Server(REFERENCE / "serve_page.py", scene_file)
    yield made
    made.end()


@pytest.fixture(scope="module")
def downloads(tmp_path_factory):
    return tmp_path_factory.mktemp("downloads")


@pytest.fixture(scope="module")
def browser(server, downloads):
    """On the page; `first` is what it says at once."""
    made = Browser(downloads=downloads)
    try:
        made.go(server.address)
        made.first = made.wait("document.querySelector('#status')?.innerText")
        made.wait("window.trachea?.last", 600)
        yield made
    finally:
        made.close()


def settle(browser):
    """Wait until no frame has come for a while: those of earlier poses are late."""
    frames = -1
    while frames != (frames := browser.run("trachea.stats.frames")):
        time.sleep(0.3)


def place(browser, at):
    """Put the tool there; force and detail of the frame of that pose."""
    before = browser.run("trachea.stats.frames")
    browser.run(f"trachea.place({', '.join(map(str, at))})")
    browser.wait(f"trachea.stats.frames > {before}")
    settle(browser)
    return browser.run(FORCE), browser.run(DETAIL)


def changes(browser, act):
    """The label of the force before and after."""
    before = browser.run(FORCE)
    act()
    browser.wait(f"{FORCE} !== {json.dumps(before)}")
    settle(browser)
    return before, browser.run(FORCE)


@needs_browser
def test_the_page_is_there_before_the_scene(browser):
    assert re.match("reading|compiling", browser.first)
    assert browser.run("location.search") == ""  # the token does not stay in the address


@needs_browser
def test_a_drag_a_key_and_a_click_change_the_force(browser):
    assert browser.run(FORCE) == "no contact"
    x, y = browser.run("trachea.screen()")
    _, pressed = changes(browser, lambda: browser.drag((x, y), (x, y + 30)))
    assert re.fullmatch(r"F \d\.\d{4} N", pressed)
    assert browser.run("trachea.pose()[10]") < 18
    changes(browser, lambda: browser.key("ArrowDown"))
    at = browser.run("trachea.pose()[9]")
    browser.key("ArrowRight", shift=True)
    assert browser.run("trachea.pose()[9]") == pytest.approx(at + 0.05)
    browser.key("KeyE")
    assert browser.run("trachea.pose()[5]") == pytest.approx(-np.sin(np.pi / 36))
    x, y = browser.run("trachea.screen()")
    changes(browser, lambda: browser.drag((x + 90, y + 60), (x + 90, y + 60), steps=1))
    assert not browser.errors


@needs_browser
def test_the_label_is_that_of_simulate(browser):
    assert [place(browser, at)[0] for at in PLACES[:2]] == LABELS[:2]


def test_the_labels_here_are_those_of_simulate(simulation):
    with h5py.File(simulation) as file:
        force, status = file["series"]["force"][()], file["series"]["status"][()]
    assert [f"F {v:.4f} N" for v in np.linalg.norm(force[:2], axis=1)] == LABELS[:2]
    assert list(status[2:]) == [PressStatus.NO_CONTACT, PressStatus.BEHIND_GAP]


@needs_browser
def test_where_there_is_no_force_the_page_says_why_and_keeps_the_surface(browser):
    assert place(browser, PLACES[2]) == (LABELS[2], "the tool does not touch")
    why = f"{PressStatus.BEHIND_GAP.message} (grey: the last surface)"
    assert place(browser, PLACES[3]) == (LABELS[3], why)
    assert browser.run("trachea.finite()")


@needs_browser
def test_a_slider_changes_the_force_and_compiles_nothing(browser, server):
    shown = browser.run("[...document.querySelectorAll('[id^=value-]')].map((e) => e.id)")
    assert shown == [f"value-{name}" for name in ("EI_L", "k_M", "k_1", "k_3", "EA_L")]
    place(browser, PLACES[0])
    before = server.compiled
    box = browser.run("document.querySelector('#value-k_M').getBoundingClientRect().toJSON()")
    at = box["x"] + 0.8 * box["width"], box["y"] + box["height"] / 2

    def click():
        browser.mouse("mousePressed", *at)
        browser.mouse("mouseReleased", *at, buttons=0)

    changes(browser, click)
    browser.run("document.querySelector('#reset').click()")
    browser.wait(f"{FORCE} === 'no contact'")
    assert server.compiled == before > 0


@pytest.fixture(scope="module")
def recording(browser, downloads):
    """play.html of two steps, and the positions of the first."""
    button = "document.querySelector('#record')"
    browser.run(f"{button}.click()")
    browser.wait(f"{button}.innerText === 'end and save'")
    place(browser, PLACES[0])
    moved = np.array(browser.run("Array.from(trachea.positions())"))
    place(browser, PLACES[3])
    browser.run(f"{button}.click()")
    wait_until((downloads / "play.html").exists, 30)
    return downloads / "play.html", moved


@needs_browser
def test_a_recording_is_one_file_with_its_notice(recording):
    text = recording[0].read_text()
    assert "Three.js Authors" in text
    assert "Permission is hereby granted" in text


@needs_browser
def test_no_request_leaves_this_machine(browser, server):
    addresses = [a for a in browser.requests if not a.startswith(("data:", "blob:"))]
    assert len(addresses) > 10
    assert {a.split("/")[2] for a in addresses} == {f"127.0.0.1:{server.port}"}
    assert not browser.errors  # nothing broke the Content-Security-Policy


def test_only_the_page_itself_is_answered(server):
    good = f"/?token={server.token}"
    status, page, heads = server.get(good)
    policy = heads["content-security-policy"]
    assert status == 200
    assert b"<script>" not in page  # each has the nonce of the policy
    assert "default-src 'none'" in policy
    assert "'unsafe-inline'" not in policy.split("style-src")[0]
    cookie = heads["set-cookie"].split(";")[0]
    assert {"HttpOnly", "SameSite=Strict"} < set(heads["set-cookie"].split("; "))
    own = f"http://127.0.0.1:{server.port}"
    assert server.get("/core.js", Cookie=cookie, Origin=own)[0] == 200
    for path, given in [
        ("/", {}), ("/?token=", {}), (f"{good}x", {}), (good[:-1], {}), ("/core.js", {}),
        ("/scene.bin", {"Cookie": cookie[:-1]}), (good, {"Host": "evil.example"}),
        (good, {"Host": f"evil.example:{server.port}"}), (good, {"Host": None}),
        (good, {"Origin": "http://evil.example"}), (good, {"Origin": "null"}),
        (good, {"Origin": "http://127.0.0.1:1"}),
        ("/core.js", {"Cookie": cookie, "Sec_Fetch_Site": "same-site"}),
    ]:  # fmt: skip
        assert server.get(path, **given)[0] == 403, (path, given)
    for path in ("/../../etc/passwd", "/page.py", "/..%2fpage.py", "/docs", "/openapi.json"):
        assert server.get(path, Cookie=cookie)[0] == 404, path
    assert server.get("/_nicegui/3.18.0/static/..%2f..%2fapp.py", Cookie=cookie)[0] == 404


def test_a_browser_is_opened_once_the_page_answers(server):
    """The web server starts what it calls at its start before it listens."""
    wait_until(lambda: any("page" in line for line in server.lines), 30)
    assert "page found\n" in server.lines


def test_it_listens_on_loopback_alone(server):
    rows = Path("/proc/net/tcp").read_text().split("\n") if sys.platform == "linux" else []
    found = [r.split()[1] for r in rows[1:] if r and r.split()[3] == "0A"]
    mine = [a for a in found if int(a.split(":")[1], 16) == server.port]
    if not mine:
        pytest.skip("no list of sockets")
    assert mine == [f"0100007F:{server.port:04X}"]


NICEGUI = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"


@pytest.mark.parametrize("path", ["/frames", NICEGUI])
def test_both_sockets_refuse_strangers(server, path):
    with server.socket(path) as link:
        assert link.recv(timeout=60)
    for given in (
        {"origin": "http://evil.example"}, {"origin": None}, {"origin": "http://127.0.0.1:1"},
        {"token": "x"}, {"token": f"{server.token}x"},
    ):  # fmt: skip
        with pytest.raises(InvalidStatus) as refused, server.socket(path, **given):
            pass
        assert refused.value.response.status_code == 403
    mark = "&" if "?" in path else "?"
    asked = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec_WebSocket_Version": "13",
             "Sec_WebSocket_Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Host": "evil.example",
             "Origin": "http://evil.example"}  # fmt: skip
    assert server.get(f"{path}{mark}token={server.token}", **asked)[0] == 403


#: Of the outside of the wall, mm.
RADIUS = 12.6
GOOD = [1, 0, 0, 0, 1, 0, 0, 0, 1, 30, 16, 0]


def posed(pose, tool=0, **more):
    """A message of the page."""
    return json.dumps({"tool": tool, "pose": pose} | more)


def test_messages_that_are_none_close_the_socket(server):
    bad = [
        "x" * 2**20, "no JSON", '"other"', "[" * 4000, posed(GOOD[:11]), posed([*GOOD[:11], 1e300]),
        posed([2, *GOOD[1:]]), posed([*GOOD[:11], np.nan]), posed(GOOD, more=1), posed(GOOD, 1),
        posed(GOOD, -1), posed(GOOD, True), json.dumps({"pose": GOOD}),
        posed([True, *GOOD[1:]]), b"\0" * 40,
    ]  # fmt: skip
    for message in bad:
        with server.socket() as link:
            link.recv(timeout=60)
            link.send(message)
            with pytest.raises(ConnectionClosed):
                link.recv(timeout=60)
    with server.socket() as link:  # and the server is well
        assert len(link.recv(timeout=60)) >= 40


def test_dragged_about_the_wall_no_row_needs_another_plan(server):
    """5 x 5 x 5: along, round (all the rings) and into the wall."""
    found = []
    with server.socket() as link:
        link.recv(timeout=60)
        for s in np.linspace(8, 52, 5):
            for phi in np.linspace(-1.9, 1.9, 5):
                for gap in (1.0, -0.5, -1.0, -2.0, -3.0):
                    off = RADIUS + 5 + gap
                    pose = [*GOOD[:9], s, off * np.cos(phi), off * np.sin(phi)]
                    link.send('"drawn"')
                    link.send(posed(pose))
                    head = np.frombuffer(link.recv(timeout=60)[:40], np.float32)
                    assert np.isfinite(head).all()
                    found.append(PressStatus(int(head[2])))
    assert len(found) == 125
    assert PressStatus.OFF_PLAN not in found
    assert found.count(PressStatus.OK) >= 75


@needs_browser
def test_a_second_page_takes_over_and_the_first_says_so(browser, server):
    with server.socket() as link:
        link.recv(timeout=60)
        browser.wait("/another page/.test(document.querySelector('#status').innerText)")


@needs_browser
def test_a_recording_plays_from_disk(browser, recording):
    """Its steps, with the positions that the page had."""
    file, moved = recording
    del browser.requests[:]
    browser.go(file.as_uri())
    browser.wait("location.protocol === 'file:' && window.trachea?.last")
    assert browser.run("document.title") == "a <short> tube"
    assert browser.run(FORCE) == LABELS[0]
    step = browser.run("trachea.deviation")  # largest |u| over 32767, halved by rounding
    played = np.array(browser.run("Array.from(trachea.positions())"))
    assert abs(played - moved).max() <= 0.5 * step + 1e-5
    browser.run("document.getElementById('play').click()")
    browser.wait("document.getElementById('row').value === '1'")
    assert browser.run(FORCE) == LABELS[3]
    browser.run("document.getElementById('play').click()")
    assert not browser.errors
    assert not [a for a in browser.requests if not a.startswith(("file:", "data:", "blob:"))]


def test_a_recording_of_another_version_is_refused(simulation, tmp_path, monkeypatch, capsys):
    file = Path(shutil.copy(simulation, tmp_path))
    with h5py.File(file, "r+") as changed:
        changed.attrs["schema_version"] = 1
    with pytest.raises(PlayError, match="version 1; expected 2; simulate the scene again"):
        of_file(file)
    assert run(monkeypatch, capsys, "play", file.parent)[0] == 2
    shutil.copy(simulation, file)
    assert run(monkeypatch, capsys, "play", file.parent)[0] == 0  # the folder of a simulation
    assert file.with_name("play.html").exists()
    file.write_text("none")
    with pytest.raises(PlayError, match="no HDF5 file"):
        of_file(file)


def test_bad_input_ends_the_command(server, scene_file, tmp_path, monkeypatch, capsys):
    taken = run(monkeypatch, capsys, "view", scene_file, "--port", server.port)
    assert taken[0] == 2
    assert f"--port: {server.port} cannot be used" in taken[2]
    none = run(monkeypatch, capsys, "view", tmp_path / "none.toml")
    assert none[0] == 2
    assert "there is no such file" in none[2]
    none = run(monkeypatch, capsys, "view", shutil.copy(scene_file, tmp_path / "simulation.h5"))
    assert "a simulation.h5 plays: jaxtrachea play" in none[2]
    none = run(monkeypatch, capsys, "play", tmp_path / "none.h5")
    assert none[0] == 2
    assert "name a simulation.h5" in none[2]
    broken = tmp_path / "broken.toml"
    broken.write_text("[path")
    assert "not valid TOML" in run(monkeypatch, capsys, "view", broken)[2]


#: Scenes that no hand can move, and why.
UNMOVED = {"cross_sections": "deforming cross-sections"}


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda p: p.stem)
def test_each_scene_is_refused_before_the_page_or_can_be_moved(path, monkeypatch, capsys):
    if path.stem in UNMOVED:
        code, _, said = run(monkeypatch, capsys, "view", path)
        assert code == 2
        assert UNMOVED[path.stem] in said
        assert f"jaxtrachea simulate {path}" in " ".join(said.split())
        return
    spec, _ = for_a_mouse(load_scene_spec(path))
    relaxes = path.stem == "relaxation"
    assert spec.tool is not None
    assert (spec.relaxation is not None) == relaxes
    assert spec.path[-1].duration == (1000.0 if relaxes else None)


def test_a_force_that_relaxes_falls_while_the_hand_rests(tmp_path):
    """From the jump to the long run; a twelfth of the force lasts beyond it in 0.2 s, none in 2."""
    scene = tmp_path / "relaxing.toml"
    law = '[relaxation]\nbranches = "prony-1"\ngamma_1 = 1.0\ntau_1 = "0.08 s"\n'
    scene.write_text(SCENE.replace("[tool]", law + "[tool]"))
    live = Live(scene)
    thread = threading.Thread(target=live.run)
    thread.start()
    try:
        wait_until(lambda: live.steps or live.state.phase == "failed", 600)
        assert live.state.phase == "ready", live.state
        clear = len(live.steps)
        time.sleep(0.5)
        assert len(live.steps) == clear  # nothing changes, nothing is shown
        pose = live.handled.poses[0].copy()
        pose[9:] = PLACES[0]
        live.move(pose)
        time.sleep(3.0)
        steps = [f for f in live.steps if f.has_force(0)]
    finally:
        live.end()
        thread.join()
    assert not live.fault
    force = np.array([np.linalg.norm(f.touches[0].force) for f in steps])
    assert len(force) > 4
    assert (np.diff(force) < 0).all()
    session = live.handled.session()
    turn = np.eye(3)
    session.step(turn, live.handled.poses[0, 9:], np.float64(0))
    lasting = np.linalg.norm(session.step(turn, PLACES[0], np.float64(1e9)).force)
    assert force[-1] == pytest.approx(lasting, rel=1e-3)
    assert 1.0 < force[0] / lasting <= 2.0  # 1 + gamma of a jump
    begin = np.array([f.time for f in steps]) - steps[0].time
    decay = (force / lasting - 1) / (force[0] / lasting - 1)
    seen = begin < 0.3
    np.testing.assert_allclose(decay[seen], np.exp(-begin[seen] / 0.08), atol=0.02)


def wait_until(true, seconds):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


@needs_browser
def test_several_tools_are_seen_and_moved(tmp_path):
    """One by one by a drag and by keys; the force of each is that of `simulate` at these poses."""
    named = SCENE.replace("[tool]\n", '[[tool]]\nname = "left"\n').replace(
        "[[path]]\n", '[[tool]]\nname = "right"\nshape = "sphere"\nradius = "4 mm"\n'
        '[[path]]\ntool = "right"\npositions = [["21 mm", "20 mm", "0 mm"]]\n'
        '[[path]]\ntool = "left"\n',
    )  # fmt: skip
    (tmp_path / "two.toml").write_text(named)
    places = {"left": [30.0, 16.2, 0.0], "right": [21.0, 11.0, 11.0]}
    server, window = Server("-m", "jaxtrachea", "view", tmp_path / "two.toml", "--no-browser"), None
    try:
        window = Browser()
        window.go(server.address)
        window.wait("window.trachea?.last", 600)
        assert window.run(OTHERS) == "right: no contact"
        x, y = window.run("trachea.screen()")
        _, pressed = changes(window, lambda: window.drag((x, y), (x, y + 30)))
        assert re.fullmatch(r"F \d\.\d{4} N", pressed)
        window.key("Digit2")
        assert window.run(OTHERS) == f"left: {pressed}"
        place(window, places["right"])
        window.key("Digit1")
        found = place(window, places["left"])[0], window.run(OTHERS)
        assert not window.errors
    finally:
        server.end()
        if window is not None:
            window.close()
    with h5py.File(simulated(tmp_path / "two.toml", {n: [v] for n, v in places.items()})) as file:
        left, right = np.linalg.norm(file["series"]["force"][0], axis=-1)
    assert found == (f"F {left:.4f} N", f"right: F {right:.4f} N")


def test_a_scene_without_a_tool_gets_a_finger(scene_file):
    text = scene_file.read_text()
    press = '[path]\ns = "30 mm"\ndisplacement = ["0 mm", "-2 mm", "0 mm"]\n'
    bare = scene_file.with_name("press.toml")
    bare.write_text(text[: text.index("[tool]")] + '[model]\ncontact = "bonded"\n' + press)
    spec, notes = for_a_mouse(load_scene_spec(bare))
    assert spec.tool.shape == "capsule"
    assert spec.model.contact == "unilateral"  # a finger is not glued on
    assert spec.effects.second_plane == spec.effects.axial == "on"
    assert len(notes) == 1


def test_a_slider_is_logarithmic_about_a_positive_value():
    k = Slider("k_M", "N/mm", "", 0.1, 0.01, 1.0, log=True)
    assert k.at(k.share) == pytest.approx(0.1)
    assert k.at(0.0) == pytest.approx(0.01)
    assert k.at(1.0) == pytest.approx(1.0)


def test_values_go_back_into_the_file():
    new = with_values(SCENE, {"k_1": 0.4567891, "EI_L": 2.0})
    assert 'k_1 = "0.456789 N/mm"    # of the wall' in new
    assert new.replace("0.456789", "0.3").replace('"2 N', '"1.862 N') == SCENE
    with pytest.raises(ValueError, match="k_M: not on a line"):
        with_values('[material]\n"k_M" = "1 N/mm"', {"k_M": 2.0})


def test_a_pose_is_read_whole_or_not_at_all():
    tool, pose = read_pose(posed(GOOD, 1), 2)
    assert (tool, pose.tolist()) == (1, GOOD)
    assert read_pose('"drawn"', 1) is None
    with pytest.raises(ValueError, match="too long"):
        read_pose(" " * (LONGEST + 1), 1)


def test_a_frame_without_a_solution_has_no_numbers():
    none = np.zeros(3)
    touch = Touch(PressStatus.OFF_TUBE, np.zeros(12), none, 0.0, none)
    frame = Frame((touch, touch), 0.0, None)
    assert len(frame.pack()) == 4 * (2 + 2 * 8)
    assert not frame.has_force(1)


def test_the_event_loop_is_left_alone_by_a_thread():
    """What the thread calls when no page has come does nothing."""
    from jaxtrachea.viewer.server import Frames

    async def make():
        return Frames(Live(Path("none.toml")))

    asyncio.run(make()).changed()


def test_what_cannot_be_read_is_said(tmp_path):
    live = Live(tmp_path / "none.toml")
    live.run()
    assert live.state.phase == "failed"
    assert "none.toml" in live.state.text


def test_one_tool_of_a_list_is_the_only_one(scene_file):
    named = SCENE.replace("[tool]", '[[tool]]\nname = "ball"\nfriction = 0.3').replace(
        "[[path]]", '[[path]]\ntool = "ball"'
    )
    path = scene_file.with_name("named.toml")
    path.write_text(named)
    handled = read_handled(path)
    assert handled.names == ["tool"]
    assert handled.staged.scene.plan.friction
    assert handled.poses[0, 9:].tolist() == [30, 18, 0]

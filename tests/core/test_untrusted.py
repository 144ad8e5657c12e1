"""Headers of images and checkpoints that anyone may have written: what is not exactly a render's is
one clear line, and nothing of it takes effect."""

import copy
import hashlib
import json
import os
import string

from mis_integrators.app import checkpoint, cli, cluster, loading, reproduce
from mis_integrators.core.session import make_session
from mis_integrators.core.untrusted import Fields, Malformed, parse

import hypothesis
import hypothesis.strategies as st
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from lamplit import read, render, write_scene
from selection import extended

NAN = float("nan")
GOOD = {
    "options": {
        "plugin": "bdpm",
        "variables": [["size", "8"]],
        "parameters": [["bdd", "0"]],
        "variant": "llvm_ad_rgb",
        "sensor": 0,
        "all_views": False,
        "seed": 3,
        "spp": 2,
    },
    "learned": {},
    "versions": "mis_integrators 0",
}
REMOVE = object()

# What an option must not be, and the same for what is outside the options. Each entry is one
# hostile header.
OPTIONS = {
    "plugin": [
        "../../evil2",
        "/tmp/evil",
        "no_such_plugin",
        "",
        7,
        ["bdpm"],
        {"type": "bdpm"},
        "bdpm\n",
        "path\0",
        "independent",
        "prb",
        "batch",
        True,
        REMOVE,
    ],
    "variables": [
        {"size": "8"},
        [["size"]],
        [["size", 8]],
        [["size", "8", "9"]],
        [["", "8"]],
        [["a=b", "8"]],
        [["size", "8\x1b[2J"]],
        "size=8",
        None,
        [["size", "8" * 5000]],
        REMOVE,
    ],
    "parameters": [
        [["bdd", 0]],
        [["bdd", None]],
        {"bdd": "0"},
        [["../bdd", "0"]],
        [["bdd", "\u202e0"]],
        [[["bdd"], "0"]],
        3,
        REMOVE,
    ],
    "variant": ["llvm", "scalar_rgb; import os", 0, None, ["llvm_ad_rgb"], REMOVE],
    "sensor": [-1, 1.0, "0", True, 10**30, None, REMOVE],
    "all_views": [0, "yes", None, [], REMOVE],
    "seed": [-1, 2**32, 1.5, "x", None, True, REMOVE],
    "spp": [0, -5, "x", 1.5, NAN, float("inf"), 10**400, None, [4], True, 2**31, REMOVE],
    # Options of the command that no header may set, and what is none.
    "scheduler": ["tcp://192.0.2.1:8786"],
    "scene": ["/etc/passwd"],
    "output": ["/tmp/other.exr"],
    "checkpoint": [1.0],
    "resume": [True],
    "workers": [4],
    "time": [1e9],
    "target_error": [1e-9],
    "like": ["other.exr"],
    "preview": [1.0],
    "frames": [True],
    "quiet": [True],
    "\x1b]0;title\x07": [1],
}
WHOLE = [
    None,
    3,
    "text",
    [],
    {},
    {"options": {}},
    {**GOOD, "options": []},
    {**GOOD, "versions": 3},
    {**GOOD, "versions": "\x1b[31mred"},
    {**GOOD, "more": 1},
    {name: value for name, value in GOOD.items() if name != "learned"},
]
TEXTS = ["", "{", "nul", "[" * 100_000, '{"options": NaN}', "\x00", '{"a": ' * 20_000, "1" * 5000]


def changed(name, value) -> dict:
    header = copy.deepcopy(GOOD)
    if value is REMOVE:
        del header["options"][name]
    else:
        header["options"][name] = value
    return header


CORPUS = (
    [json.dumps(changed(name, value)) for name, values in OPTIONS.items() for value in values]
    + [json.dumps(whole) for whole in WHOLE]
    + TEXTS
)


@pytest.fixture
def scene(tmp_path, rgb):
    return write_scene(tmp_path)


def write_image(path, header) -> None:
    OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header},
        {"Y": np.zeros((2, 2), np.float32)},
    ).write(str(path))


def one_line(error: str) -> bool:
    return (
        error.count("\n") == 1
        and error[:-1].isprintable()
        and len(error) < 1200
        and "Traceback" not in error
    )


@pytest.fixture
def nothing_happens(monkeypatch):
    """Fails the test where a scene is loaded, a checkpoint is read or a cluster is looked for."""

    def refuse(*_, **__):
        raise AssertionError("the header took effect")

    monkeypatch.setattr(loading, "load", refuse)
    monkeypatch.setattr(checkpoint, "read", refuse)
    monkeypatch.setattr(cluster, "connected", refuse)


def test_corpus_is_large():
    assert len(set(CORPUS)) == len(CORPUS) >= 100


@pytest.mark.parametrize("header", CORPUS, ids=range(len(CORPUS)))
def test_hostile_header_is_one_line(scene, tmp_path, capsys, nothing_happens, header):
    write_image(tmp_path / "told.exr", {reproduce.ATTRIBUTE: header})
    assert render(scene, "--like", tmp_path / "told.exr", "-o", tmp_path / "new.exr") == 1
    error = capsys.readouterr().err
    assert one_line(error) and "told.exr" in error, error
    assert not (tmp_path / "new.exr").exists()


@pytest.mark.parametrize("value", [3, 1.5, (1.0, 2.0), np.zeros((3, 3), np.float32)], ids=str)
def test_header_that_is_no_text(scene, tmp_path, capsys, nothing_happens, value):
    write_image(tmp_path / "told.exr", {reproduce.ATTRIBUTE: value})
    assert render(scene, "--like", tmp_path / "told.exr", "-o", tmp_path / "new.exr") == 1
    assert one_line(capsys.readouterr().err)


def test_files_that_are_no_images(scene, tmp_path, capsys, nothing_happens):
    """Among them a FIFO, which nobody writes to, and an image of which the half is missing."""
    os.mkfifo(tmp_path / "fifo.exr")
    write_image(tmp_path / "whole.exr", {reproduce.ATTRIBUTE: json.dumps(GOOD)})
    (tmp_path / "half.exr").write_bytes((tmp_path / "whole.exr").read_bytes()[:100])
    (tmp_path / "folder.exr").mkdir()
    for name in ("fifo.exr", "half.exr", "folder.exr"):
        assert render(scene, "--like", tmp_path / name, "-o", tmp_path / "new.exr") == 1
        assert one_line(capsys.readouterr().err)


def test_good_header_is_rendered(scene, tmp_path):
    """Else all tests above would pass whatever is in a header."""
    write_image(tmp_path / "told.exr", {reproduce.ATTRIBUTE: json.dumps(GOOD)})
    assert (
        render(scene, "--like", tmp_path / "told.exr", "-o", tmp_path / "new.exr", "--quiet") == 0
    )
    header, image = read(tmp_path / "new.exr")
    assert (
        header["integrator"],
        header["seed"],
        header["spp"],
        header["bdd"],
        image.shape[:2],
    ) == ("bdpm", 3, 2, 0, (8, 8))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4)
    ),
    max_leaves=10,
)
OTHER_TEXT = st.text(st.characters(exclude_characters=string.printable), min_size=1, max_size=5)


@hypothesis.settings(max_examples=300, deadline=None, derandomize=True)
@hypothesis.given(
    st.sampled_from([*GOOD["options"], "denoise", "scheduler", "scene"]), JSON | OTHER_TEXT
)
def test_any_value_of_an_option_is_refused_or_of_its_type(tmp_path_factory, name, value):
    """What is taken has the type and the range of the command's own option; what is not is one
    printable line."""
    path = tmp_path_factory.getbasetemp() / "told.exr"
    write_image(path, {reproduce.ATTRIBUTE: json.dumps(changed(name, value))})
    try:
        recipe = reproduce.read(path)
    except Malformed as error:
        assert str(error).isprintable() and len(str(error)) < 1000
        return
    options = recipe.options
    assert set(options) == {*GOOD["options"], "denoise"} and name in options
    assert (
        options["plugin"] in (None, *reproduce.MITSUBA_INTEGRATORS, *reproduce._plugins.PLUGINS)
        and options["variant"] in mi.variants()
    )
    assert (
        1 <= options["spp"] < 2**31
        and 0 <= options["seed"] < 2**32
        and type(options["all_views"]) is type(options["denoise"]) is bool
        and options["sensor"] >= 0
    )
    for pairs in (options["variables"], options["parameters"]):
        assert all(type(one) is type(other) is str and other.isprintable() for one, other in pairs)


@hypothesis.settings(max_examples=200, deadline=None, derandomize=True)
@hypothesis.given(st.text(max_size=200) | JSON.map(json.dumps))
def test_any_text_is_refused_or_read(text):
    try:
        Fields(parse(text, "it"), "it").finish()
    except Malformed as error:
        assert str(error).isprintable() and len(str(error)) < 500


# --- What a session has learned -----------------------------------------------

LEARNED = {
    "bdpm": [
        {"radii": {}},
        {
            "radii": {"indirect": 0.1},
            "caustic_radii": {"iterations": 0.0},
            "light_share": 1.0,
            "direct_light": {},
        },
        {
            "radii": {"indirect": -1, "caustic": 0.1},
            "caustic_radii": {"iterations": 0.0},
            "light_share": 1.0,
            "direct_light": {},
        },
        {
            "radii": {"indirect": 1, "caustic": 1e999},
            "caustic_radii": {"iterations": 0.0},
            "light_share": 1.0,
            "direct_light": {},
        },
        {
            "radii": {"indirect": 1, "caustic": 1},
            "caustic_radii": {"iterations": 0.0},
            "light_share": 1.0,
            "direct_light": {"photon_light": 1, "photon_error": -1, "iterations": 1},
        },
        {
            "radii": {"indirect": 1, "caustic": 1},
            "caustic_radii": {"iterations": 0.0},
            "light_share": 1.0,
            "direct_light": {"photon_light": 1, "photon_error": 1},
        },
        {
            "radii": {"indirect": 1, "caustic": 1},
            "caustic_radii": {"iterations": 0.0},
            "light_share": 2.0,
            "direct_light": {},
        },
        {
            "radii": {"indirect": 1, "caustic": 1, "more": 1},
            "caustic_radii": {"iterations": 0.0},
            "light_share": 1.0,
            "direct_light": {},
        },
    ],
    "bdpm_auto": [
        {"plugin": "../../evil2", "reasons": [], "errors": {}, "session": {}},
        {"plugin": "bdpm", "reasons": [], "errors": {}, "session": {}},
        {"plugin": "path", "parameters": {}, "reasons": [], "errors": {}, "session": {}},
        {"plugin": "path", "reasons": ["\x1b[2J"], "errors": {}, "session": {"camera_paths": 1}},
        {
            "plugin": "path",
            "reasons": [],
            "errors": {"path": "small"},
            "session": {"camera_paths": 1},
        },
        {"plugin": "path", "reasons": [], "errors": {}, "session": {"camera_paths": -1}},
        {"plugin": "path", "reasons": [], "errors": {}, "session": [1]},
        {"plugin": "path", "reasons": [], "errors": {}},
    ],
    "bdpt": [{"radius": 1}],
    "bdpt_ris": [
        {"light_tracing": 1.0},
        {"radius": 1},
    ],
    "vcm": [
        {"radius": 0},
        {"radius": None},
        {"radius": 1e300},
        {"radius": 1e-300},
        {"radius": 1, "more": 1},
    ],
    "volpath_multiview": [{"radius": 1}],
    "path": [
        {"samples_per_iteration": 0},
        {"samples_per_iteration": 10**9},
        {"samples_per_iteration": 2.0},
        {"samples_per_iteration": 2, "more": 1},
    ],
}


@pytest.fixture
def sessions(scene):
    """Makes sessions of small renders."""

    def make(plugin):
        loaded = loading.load(scene, {"size": "8"}, plugin, {})
        return make_session(loaded.integrator, loaded.scene, loaded.scene.sensors()[0], 3, 2)

    return make


SOME = "bdpm_auto", "bdpt_ris", "path"


@pytest.mark.parametrize(
    "plugin", [*SOME, *extended(*(plugin for plugin in LEARNED if plugin not in SOME))]
)
def test_what_no_session_can_have_learned(scene, sessions, tmp_path, capsys, plugin):
    """By the session itself, by an image, and by a checkpoint."""
    for learned in [*LEARNED[plugin], [1], "text", 3, None, [], 0]:
        with pytest.raises(Malformed) as error:
            sessions(plugin).recall(learned)
        assert str(error.value).isprintable()
        options = {**GOOD["options"], "plugin": plugin, "parameters": []}
        write_image(
            tmp_path / "told.exr",
            {
                reproduce.ATTRIBUTE: json.dumps(
                    {**GOOD, "options": options, "learned": learned, "versions": cli.versions()}
                )
            },
        )
        assert render(scene, "--like", tmp_path / "told.exr", "-o", tmp_path / "new.exr") == 1
        assert one_line(capsys.readouterr().err)


@pytest.mark.parametrize("plugin", LEARNED)
def test_what_a_session_has_learned_is_taken(sessions, plugin):
    one, other = sessions(plugin), sessions(plugin)
    one.iterate()
    other.recall(json.loads(json.dumps(one.learned)))
    assert other.learned == one.learned


@hypothesis.settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
)
@hypothesis.given(st.sampled_from(["radii", "direct_light", "more"]), JSON)
def test_any_value_that_was_learned(sessions, name, value):
    learned = {
        "radii": {"indirect": 0.1, "caustic": 0.1},
        "caustic_radii": {"iterations": 0.0},
        "light_share": 1.0,
        "direct_light": {},
        name: value,
    }
    session = sessions("bdpm")
    try:
        session.recall(json.loads(json.dumps(learned)))
    except Malformed as error:
        assert str(error).isprintable()
    else:
        assert all(0 < radius < float("inf") for radius in session.radii.values())


# --- Checkpoints --------------------------------------------------------------


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """The checkpoint of a finished render."""
    folder = tmp_path_factory.mktemp("kept")
    mi.set_variant("llvm_ad_rgb")
    options = "-i", "bdpm", "-D", "size=8", "--spp", 2, "--checkpoint", 100, "--quiet"
    assert render(write_scene(folder), *options, "-o", folder / "a.exr") == 0
    return (folder / "a.checkpoint").read_bytes()


@pytest.fixture
def kept(rendered, tmp_path):
    """A copy of it, beside the same scene in another folder."""
    copy = tmp_path / "a.checkpoint"
    copy.write_bytes(rendered)
    return copy


def resume(scene, kept) -> int:
    return render(
        scene,
        "-i",
        "bdpm",
        "-o",
        kept.with_suffix(".exr"),
        "-D",
        "size=8",
        "--spp",
        4,
        "--resume",
        "--quiet",
    )


def forge(content: bytes, change, tail: bytes = b"") -> bytes:
    """A checkpoint that has its checksum, with a header that ``change`` has changed."""
    body = content[len(checkpoint.MAGIC) + 32 :]
    end = 8 + int.from_bytes(body[:8], "little")
    header = json.loads(body[8:end])
    header = json.dumps(header if (changed := change(header)) is None else changed).encode()
    body = len(header).to_bytes(8, "little") + header + body[end:] + tail
    return checkpoint.MAGIC + hashlib.sha256(body).digest() + body


FORGED = {
    **{
        f"without {name}": lambda header, name=name: header.pop(name) and None
        for name in ("identity", "learned", "done", "seconds", "compiling", "arrays")
    },
    **{
        f"identity without {name}": lambda header, name=name: header["identity"].pop(name) and None
        for name in ("plugin", "files", "variables", "settings", "versions", "seed")
    },
    **{
        f"done {value}": lambda header, value=value: header.update(done=value)
        for value in (
            10**9,
            [10**9, []],
            [1e9, []],
            [2, [1]],
            [-1, []],
            [2, [3, 3]],
            ["2", []],
            [2],
            [2, {}],
            None,
            [True, []],
            [10**8, [10**8 + 7]],
        )
    },
    **{
        f"seconds {value}": lambda header, value=value: header.update(seconds=value)
        for value in (-1, "1", None, 1e999, [1])
    },
    "list": lambda header: [1, 2],
    "text": lambda header: "text",
    "learned list": lambda header: header.update(learned=[1]),
    "learned other": lambda header: header.update(learned={"radius": 1}),
    "learned radius": lambda header: header["learned"]["radii"].update(indirect=-1.0),
    "identity escape": lambda header: header["identity"].update(plugin="\x1b[2Jbdpm"),
    "identity files": lambda header: header["identity"].update(files=[1]),
    "identity list": lambda header: header.update(identity=[1]),
    "another field": lambda header: header.update(scheduler="tcp://192.0.2.1:1"),
    "nothing done": lambda header: header.update(done=[0, []]),
    "nothing learned": lambda header: header.update(learned={}),
    "empty": lambda header: header["arrays"].update(total=[0, 2**32 - 1, 2**32 - 1]),
    "shape": lambda header: header["arrays"].update(total=[1, 1, 1]),
    "shapes swapped": lambda header: header["arrays"].update(
        total=list(reversed(header["arrays"]["total"]))
    ),
    "shape of floats": lambda header: header["arrays"].update(total=[1.5, 2]),
    "shape negative": lambda header: header["arrays"].update(total=[-1, 8, 4]),
    "shape huge": lambda header: header["arrays"].update(total=[2**31, 2**31, 2**31]),
    "other sums": lambda header: header.update(
        arrays={f"{name}x": shape for name, shape in header["arrays"].items()}
    ),
    "no sums": lambda header: header.update(arrays={}),
    "sums list": lambda header: header.update(arrays=[[1, 2]]),
}


@pytest.mark.parametrize("name", FORGED)
def test_forged_checkpoint_is_one_line(scene, kept, capsys, name):
    kept.write_bytes(forge(kept.read_bytes(), FORGED[name]))
    assert resume(scene, kept) == 4
    error = capsys.readouterr().err
    assert one_line(error) and "cannot resume" in error, error


def test_other_odd_checkpoints(scene, kept, tmp_path, capsys):
    """Bytes that follow, sums that are not finite, a header longer than the file, no header at all,
    a FIFO, a folder."""
    content = kept.read_bytes()
    assert resume(scene, kept) == 0  # as it is, it is taken
    kept.write_bytes(forge(content, lambda header: None))
    assert resume(scene, kept) == 0
    body = content[len(checkpoint.MAGIC) + 32 :]
    nan = body[:-8] + np.array([np.nan], "<f8").tobytes()
    odd = [forge(content, lambda header: None, b"12345678")]
    odd += [
        checkpoint.MAGIC + hashlib.sha256(each).digest() + each
        for each in (nan, b"\xff" * 8 + body[8:], b"", b"\x01")
    ]
    for each in odd:
        kept.write_bytes(each)
        assert resume(scene, kept) == 4
        assert one_line(capsys.readouterr().err)
    kept.unlink()
    os.mkfifo(kept)
    assert resume(scene, kept) == 4
    assert "not a regular file" in (error := capsys.readouterr().err) and one_line(error)
    kept.unlink()
    kept.mkdir()
    assert resume(scene, kept) == 4
    assert one_line(capsys.readouterr().err)

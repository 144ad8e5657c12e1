"""`--tev`: what a viewer gets is what tev's protocol says, and a render needs no viewer."""

import socket
import struct
import threading
import time

from mis_integrators.app import options, tev

import numpy as np
import pytest
from test_cli import SCENE, FakeSession, read, render


class Listener:
    """A server on 127.0.0.1 that reads packets as tev's source reads them (`Ipc.cpp`)."""

    def __init__(self):
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.socket.settimeout(20)
        self.address = f"127.0.0.1:{self.socket.getsockname()[1]}"
        self.packets = []
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self):
        connection, _ = self.socket.accept()
        with connection, connection.makefile("rb") as stream:
            while head := stream.read(4):
                (length,) = struct.unpack("<I", head)
                self.packets.append(parse(stream.read(length - 4)))

    def received(self):
        """All packets, when the sender has left."""
        self.thread.join(20)
        assert not self.thread.is_alive()
        self.socket.close()
        return self.packets


def parse(content: bytes) -> dict:
    """The fields of a packet, which has no byte more than they take."""
    place = 0

    def take(form):
        nonlocal place
        values = struct.unpack_from(f"<{form}", content, place)
        place += struct.calcsize(f"<{form}")
        return values

    def text():
        nonlocal place
        end = content.index(b"\0", place)
        found, place = content[place:end].decode(), end + 1
        return found

    kind, focus = take("B?")
    found = {"kind": kind, "focus": focus, "name": text()}
    if kind == 4:
        found["width"], found["height"], count = take("iii")
        found["channels"] = [text() for _ in range(count)]
    else:
        assert kind == 5
        (count,) = take("i")
        found["channels"] = [text() for _ in range(count)]
        x, y, width, height = take("iiii")
        values = np.frombuffer(content, "<f4", offset=place).reshape(count, height, width)
        place = len(content)
        found |= {"x": x, "y": y, "image": np.moveaxis(values, 0, 2)}
    assert place == len(content)
    return found


@pytest.fixture
def listener():
    listener = Listener()
    yield listener
    listener.socket.close()


@pytest.fixture
def scene(tmp_path, rgb):
    file = tmp_path / "scene.xml"
    file.write_text(SCENE)
    return file


@pytest.fixture
def use(monkeypatch):
    """Let the command render with a fake session."""

    def use(session):
        monkeypatch.setattr("mis_integrators.app.request.make_session", lambda *_: session)
        return session

    return use


@pytest.fixture
def nobody():
    """An address at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    return f"127.0.0.1:{port}"


def test_packets_are_those_of_the_protocol():
    """Byte by byte, the first of all; and an image of several parts, each of whole rows."""
    assert tev.create_image("a", 2, 1, ["R", "G"]) == (
        b"\x18\0\0\0"  # 24 bytes with these four
        b"\x04\x01a\0\x02\0\0\0\x01\0\0\0\x02\0\0\0R\0G\0"
    )
    rows = np.array([[[1, 2], [3, 4]]], np.float64)
    assert tev.update_image("a", rows, ["R", "G"], 7) == (
        b"\x30\0\0\0\x05\0a\0\x02\0\0\0R\0G\0" + struct.pack("<iiii4f", 0, 7, 2, 1, 1, 3, 2, 4)
    )


def test_image_is_put_together_again(listener, monkeypatch):
    monkeypatch.setattr(tev, "LARGEST_PACKET", 3 * 4 * 5 * 2)
    image = np.random.default_rng(1).uniform(size=(8, 5, 2)).astype(np.float32)
    host, port = listener.address.split(":")
    viewer = tev.Viewer((host, int(port)), "some thing.exr")
    viewer.show(image, ["R", "var.R"])
    viewer.show(2 * image, ["R", "var.R"])
    viewer.close()
    first, *parts = listener.received()
    assert first == {
        "kind": 4,
        "focus": True,
        "name": "some thing.exr",
        "width": 5,
        "height": 8,
        "channels": ["R", "var.R"],
    }
    assert [part["y"] for part in parts] == [0, 3, 6, 0, 3, 6]
    shown = np.zeros_like(image)
    for part in parts:
        assert not part["focus"] and part["x"] == 0 and part["name"] == first["name"]
        shown[part["y"] : part["y"] + len(part["image"])] = part["image"]
    np.testing.assert_array_equal(shown, 2 * image)


def test_render_is_shown_while_it_goes_on(scene, tmp_path, use, listener, capfd):
    """With each preview, and in the end the image that is written."""
    use(FakeSession())
    image = tmp_path / "a.exr"
    arguments = "-o", image, "--preview", 1e-6, "--tev", listener.address, "--quiet"
    assert render(scene, *arguments) == 0
    first, *parts = listener.received()
    assert (first["width"], first["height"], first["name"]) == (12, 8, "a.exr")
    assert first["channels"] == ["R", "G", "B", "var.R"]
    assert [part["image"].mean() for part in parts] == [1, 1.5, 2, 2.5, 3, 3]
    np.testing.assert_array_equal(parts[-1]["image"][..., 0], read(image)[1]["R"])
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("interval", [(), ("--preview", 1e-6)])
def test_nobody_listens(scene, tmp_path, use, nobody, capfd, interval):
    """One line, and the image is written."""
    use(FakeSession())
    arguments = "-o", tmp_path / "a.exr", "--tev", nobody, "--quiet", *interval
    assert render(scene, *arguments) == 0
    assert capfd.readouterr().err == (
        f"mis-render: cannot show the image in tev at {nobody}: nobody listens there; "
        "the render goes on\n"
    )
    assert read(tmp_path / "a.exr")[0]["iterations"] == 5


def test_viewer_that_comes_later_or_leaves(monkeypatch, nobody):
    """It is sought again after a while, not before; a new one gets the whole image."""
    host, port = nobody.split(":")
    viewer, image = tev.Viewer((host, int(port)), "a"), np.ones((2, 3, 1), np.float32)
    for _ in range(2):
        with pytest.raises(OSError, match="nobody listens"):
            viewer.show(image, ["Y"])
    with socket.create_server((host, int(port))) as late:
        with pytest.raises(OSError, match="nobody listens"):
            viewer.show(image, ["Y"])
        monkeypatch.setattr(tev, "ABSENCE", 0.0)
        viewer._absent_until = 0.0
        viewer.show(image, ["Y"])
        connection, _ = late.accept()
        whole = connection.recv(1000)
        assert parse(whole[4 : struct.unpack("<I", whole[:4])[0]])["kind"] == 4
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()  # at once, without a farewell
        with pytest.raises(OSError, match="the render goes on"):
            for _ in range(5):
                viewer.show(image, ["Y"])
                time.sleep(0.05)
        viewer.show(image, ["Y"])
        connection, _ = late.accept()
        assert connection.recv(5)[4] == tev.CREATE_IMAGE
        connection.close()
    viewer.close()


def test_viewer_that_does_not_read_is_left(monkeypatch):
    monkeypatch.setattr(tev, "PATIENCE", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        viewer = tev.Viewer(deaf.getsockname(), "a")
        with pytest.raises(OSError, match="timed out; the render goes on"):
            viewer.show(np.ones((2000, 2000, 4), np.float32), list("RGBA"))


@pytest.mark.parametrize("host", ["a" * 70, "no.such.host.invalid"])
def test_hosts_that_cannot_be(host):
    with pytest.raises(OSError, match="the render goes on"):
        tev.Viewer((host, 14158), "a").connect()


@pytest.mark.parametrize(
    "text, address",
    [("localhost:14158", ("localhost", 14158)), ("[::1]:80", ("::1", 80))]
    + [("localhost", None), (":80", None), ("a:0", None), ("a:65536", None), ("a:b", None)],
)
def test_addresses(text, address, capsys):
    if address:
        assert options.parse(["scene.xml", "--tev", text]).tev == address
        return
    with pytest.raises(SystemExit):
        options.parse(["scene.xml", "--tev", text])
    assert "--tev" in capsys.readouterr().err

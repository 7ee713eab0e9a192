"""A library on an index server: the same answers, and nothing is lost whatever the server does."""

import http.server
import json
import shutil
import signal
import threading

import numpy as np
import pytest

pytest.importorskip("httpx2")
import torch
from library import mixed_library  # benchmarks/library.py
from support.chroma import Chroma

from lexsplat.queries.phrases import Thing
from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.runtime.errors import LibraryError
from lexsplat.scenes.library import Library
from lexsplat.scenes.library import server as served_by
from lexsplat.scenes.library.entries import Codes
from lexsplat.scenes.library.searching import candidates

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("room_encoders")]

NAMES = ("kitchen", "office", "lab")


@pytest.fixture(scope="module")
def chroma(tmp_path_factory):
    server = Chroma(tmp_path_factory.mktemp("chroma"))
    yield server
    server.kill()


def hits(library, phrase):
    return [(hit.scene, hit.present, hit.bound) for hit in library.search(phrase).hits]


def test_the_vectors_give_the_bounds_with_a_linear_offset():
    rng = np.random.default_rng(0)
    units = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(9, 6))).float(), dim=1)
    shares = torch.ones(9)
    shares[4] = 0
    shared, offset = (torch.from_numpy(rng.normal(size=size)).float() for size in (9, 7))
    limits = torch.from_numpy(rng.uniform(0.1, 1.1, 9)).float()
    codes, text = Codes(units, shared, limits, shares, offset), rng.normal(size=6)
    numbers, vectors = served_by.code_vectors(codes)
    assert numbers.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
    cosines = units.double().numpy() @ text - shared.double().numpy()
    linear = offset[:6].double().numpy() @ text - float(offset[6])
    expected = (cosines - linear) / codes.limits.double().numpy()
    np.testing.assert_allclose(vectors @ [*text, 1.0, 0.0], expected[numbers], rtol=1e-4, atol=1e-4)
    lengths = np.linalg.norm(vectors, axis=1)
    np.testing.assert_allclose(lengths[lengths < 16.1], 16.0, rtol=1e-4)


def test_a_server_gives_the_answers_of_the_files_and_survives_its_death(rooms, chroma, tmp_path):
    library = Library.create(tmp_path / "library", index=chroma.url)
    for name in NAMES:
        library.add(rooms / name)
    alone = Library(library.root)
    for phrase in ("mug", "candle", "mug and chair", "piano", "vase next to lamp"):
        assert hits(library, phrase) == hits(alone, phrase)
    chroma.process.send_signal(signal.SIGKILL)
    chroma.process.wait()
    before = {path.name: path.read_bytes() for path in library.stage.iterdir()}
    for change in (
        lambda: library.search("mug"),
        lambda: Library(library.root, index=chroma.url).add(rooms / "lab"),
    ):
        with pytest.raises(LibraryError, match=r"no connection; start it \(chroma run"):
            change()
    assert {path.name: path.read_bytes() for path in library.stage.iterdir()} == before
    assert hits(alone, "mug")  # without the server, the files answer
    chroma.start()
    assert hits(library, "mug") == hits(alone, "mug")  # it has lost nothing
    library.remove("office")
    assert hits(library, "candle") == hits(alone, "candle") == [("lab", "yes", pytest.approx(1.3, abs=0.2))]


@pytest.mark.parametrize("step", ["_delete", "_upsert", "_mark"])
def test_a_server_that_is_killed_in_the_middle_of_adding_loses_nothing(
    rooms, chroma, tmp_path, monkeypatch, step
):
    library = Library.create(tmp_path / "library", index=chroma.url)
    for name in NAMES[:2]:
        library.add(rooms / name)
    work = getattr(served_by.Server, step)

    def killed(self, *arguments):
        if step != "_mark" or arguments[0] != "changing":
            chroma.kill()
        return work(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(served_by.Server, step, killed)
        with pytest.raises(LibraryError, match="no connection"):
            library.add(rooms / "lab")
    chroma.start()
    again = Library(library.root, index=chroma.url)
    assert again.names() == ["kitchen", "lab", "office"]
    with pytest.raises(LibraryError, match=f"verify {library.root} --repair --index"):
        again.search("candle")
    assert again.verify(repair=True) == {}
    for phrase in ("mug", "candle", "vase"):
        assert hits(again, phrase) == hits(Library(library.root), phrase)


def test_what_was_added_and_removed_without_the_server_is_noticed_and_brought_to_it(
    rooms, chroma, tmp_path, monkeypatch
):
    library = Library.create(tmp_path / "library", index=chroma.url)
    for name in NAMES[:2]:
        library.add(rooms / name)
    alone = Library(library.root)
    alone.remove("kitchen")
    alone.add(rooms / "lab")
    with pytest.raises(LibraryError, match="another state of it"):
        library.search("mug")
    assert library.verify(repair=True) == {}
    assert [name for name, *_ in hits(library, "mug")] == ["lab"]
    asked, ask = [], library.server._ask
    monkeypatch.setattr(library.server, "_ask", lambda *request: asked.append(request[1]) or ask(*request))
    library.server.repair([(record, library.codes(record)) for record in library.records()], library.stage)
    assert asked
    assert not any(path.endswith(("/upsert", "/delete")) for path in asked)


@pytest.mark.parametrize("action", ["add", "remove"])
def test_a_change_brings_to_the_server_what_it_has_missed(rooms, chroma, tmp_path, action):
    alone = Library.create(tmp_path / "library")
    for name in NAMES[:2]:
        alone.add(rooms / name)
    library = Library(alone.root, index=chroma.url)
    library.add(rooms / "lab") if action == "add" else library.remove("office")
    for phrase in ("mug", "candle", "vase"):
        assert hits(library, phrase) == hits(alone, phrase)


@pytest.mark.parametrize("lost", ["a code", "a collection"])
def test_a_server_that_has_lost_something_is_refused_until_it_is_repaired(rooms, chroma, tmp_path, lost):
    library = Library.create(tmp_path / "library", index=chroma.url)
    for name in NAMES:
        library.add(rooms / name)
    (place, *_) = (each.place for each in library.server._collections())
    if lost == "a code":
        first = next(library.server._identifiers(place))
        library.server._ask("POST", f"{place}/delete", {"ids": [first]})
    else:
        names = {
            each["id"]: each["name"] for each in library.server._ask("GET", f"{served_by._PLACE}?limit=9999")
        }
        library.server._ask("DELETE", f"{served_by._PLACE}/{names[place.split('/')[-1]]}")
    for ask in (lambda: library.search("mug"), library.verify):
        with pytest.raises(LibraryError, match=f"verify {library.root} --repair --index"):
            ask()
    assert library.verify(repair=True) == {}
    assert hits(library, "mug") == hits(Library(library.root), "mug")


def test_scenes_beyond_the_proposals_are_counted_where_they_may_hold_the_thing(
    rooms, chroma, tmp_path, monkeypatch
):
    monkeypatch.setattr("lexsplat.scenes.library.searching.PROPOSED", 1)
    library = Library.create(tmp_path / "library", index=chroma.url)
    for name in NAMES:
        library.add(rooms / name)
    found = library.search("candle")  # in office and lab, of different encoders
    assert len(found.hits) == 2
    shutil.copytree(rooms / "office", tmp_path / "office")
    library.add(tmp_path / "office")
    found = library.search("candle")
    assert (len(found.hits), found.unopened) == (2, 2)  # kitchen has the encoder of the two offices
    found = library.search("griffin")
    assert (found.hits, found.unopened) == ((), 0)


def test_two_libraries_share_a_server_and_stay_apart(rooms, chroma, tmp_path):
    first, second = (Library.create(tmp_path / name, index=chroma.url) for name in ("first", "second"))
    first.add(rooms / "kitchen")
    second.add(rooms / "office")
    assert [name for name, *_ in hits(first, "mug")] == ["kitchen"]
    assert hits(second, "mug") == []


def test_the_server_recalls_the_ten_best_of_two_hundred_mixed_scenes(chroma, tmp_path, monkeypatch):
    library = mixed_library(tmp_path / "library", 200, 8, 64)
    # A quarter of the codes, as in a library of five hundred scenes: most scenes are not proposed.
    monkeypatch.setattr("lexsplat.scenes.library.searching.PROPOSED", 400)
    served = Library(library.root, index=chroma.url)
    served.encode = library.encode
    served.server.repair([(record, served.codes(record)) for record in served.records()], served.stage)
    found = []
    for word in default_vocabulary("bundled"):
        exact = [name for name, _ in candidates(library, Thing(word)).ranked[:10]]
        proposed = [name for name, _ in candidates(served, Thing(word)).ranked[:10]]
        found += [name in proposed for name in exact]
    assert len(found) > 100
    assert np.mean(found) >= 0.99


# -- servers that are something else


def answering(status: int, body: object, wait: threading.Event | None = None):
    """A server that answers everything in one way."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def answer(self):
            if wait is not None:
                wait.wait(30)
            data = json.dumps(body).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        do_GET = do_POST = do_PUT = answer

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


@pytest.mark.parametrize(
    ("status", "body", "told"),
    [
        (200, "0.4.22", "expected Chroma with API 1.x, found '0.4.22'; use Chroma 1"),
        (200, {"hello": 1}, "expected Chroma with API 1.x"),
        (404, "gone", "found status 404"),
        (507, {"message": "disk full"}, 'disk full"}; the library is whole: fix the server, then run'),
        (500, "x" * 9999, "found status 500"),
    ],
)
def test_another_server_is_refused_in_one_line_before_anything_changes(rooms, tmp_path, status, body, told):
    server = answering(status, body)
    try:
        library = Library.create(tmp_path / "library", index=f"http://127.0.0.1:{server.server_port}")
        with pytest.raises(LibraryError) as refusal:
            library.add(rooms / "kitchen")
    finally:
        server.shutdown()
    assert told in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 500
    assert library.names() == []


def test_a_server_that_does_not_answer_is_given_up(rooms, tmp_path, monkeypatch):
    monkeypatch.setattr(served_by, "ANSWER_SECONDS", 0.2)
    silent = threading.Event()
    server = answering(200, "1.0.0", silent)
    try:
        library = Library.create(tmp_path / "library", index=f"http://127.0.0.1:{server.server_port}")
        with pytest.raises(LibraryError, match="no answer within"):
            library.add(rooms / "kitchen")
    finally:
        silent.set()
        server.shutdown()


@pytest.mark.parametrize("url", ["localhost:8000", "ftp://x", "", "/tmp/x"])
def test_what_is_no_address_is_refused(tmp_path, url):
    with pytest.raises(LibraryError, match="an address such as"):
        served_by.Server(url, "x", tmp_path)

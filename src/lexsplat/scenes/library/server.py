"""The codes of a library on an index server: Chroma, by its HTTP API.

The files of the library stay authoritative. The server proposes scenes by the inner product of the codes with a text.
The bounds of these scenes are computed from their files (`lexsplat.scenes.library.bounds`). The bound of code k is

    (u_k.t - c_k - q) / z_k    with z_k = sqrt(b_k peak), c_k = u_k.mean of the everyday words,

where q is a quantile over the codes of the scene. With the linear estimate a.t - a0 of the quantile (`Codes.offset`),
the vector ((u_k - a) / z_k, (a0 - c_k) / z_k) is stored, and (t, 1) is asked. A last coordinate makes all vectors
equally long, and is 0 in a text: graphs of neighbors by inner product are poor where lengths differ.

Each encoder has a collection. Its metadata hold the state of the library, "changing" while it is written, and the
number of its codes: a search on a server that holds another state or has lost codes is refused, and `Server.repair`
uploads what it lacks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.runtime.errors import BackendError, LibraryError
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.scenes.library.entries import Codes
from lexsplat.scenes.library.records import Record, command

VERSION = "1."
"""First characters of the versions of the API that are understood."""
CONNECT_SECONDS, ANSWER_SECONDS = 5.0, 60.0
_PLACE = "/tenants/default_tenant/databases/default_database/collections"
_HNSW = {"space": "ip", "ef_construction": 200, "max_neighbors": 32, "ef_search": 1000}
"""The graph of Chroma's index."""
_LENGTH = 16.0
"""Length of all vectors; longer ones stay as they are."""
_BATCH = 1000
_PAGE = 10_000
_CHANGING = "changing"


def code_vectors(codes: Codes) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The visible codes of a scene: their numbers ``[V]`` and vectors ``[V, D + 2]``."""
    seen = (codes.shares > 0).nonzero()[:, 0]
    shift = codes.offset[-1] - codes.shared
    vectors = torch.cat([codes.units.float() - codes.offset[:-1], shift[:, None]], 1) / codes.limits[:, None]
    rest = (_LENGTH**2 - vectors.square().sum(1)).clamp_min(0).sqrt()
    return seen.numpy(), torch.cat([vectors, rest[:, None]], 1)[seen].numpy()


def listing(stage: Path) -> str:
    """A hash of which version of which scene a library holds."""
    return fingerprint(sorted(path.name for path in stage.glob("[!.]*.safetensors")))


@dataclass(frozen=True)
class Collection:
    """The codes of the scenes with one encoder.

    Args:
        place: Its path on the server.
        group: `Record.group` of the scenes.
        state: `listing` of the library when it was written.
        codes: Number of codes when it was written; -1 if that is unknown.
    """

    place: str
    group: str
    state: str
    codes: int


class Server:
    """The collections of one library on a server. All methods raise `LibraryError` if it fails.

    Args:
        url: Its address, such as "http://localhost:8000".
        library: The library's own name.
        root: Its folder, for the remedies of errors.

    Raises:
        LibraryError: If it is no address.
        BackendError: If the package httpx2 is missing.
    """

    def __init__(self, url: str, library: str, root: Path) -> None:
        try:
            import httpx2
        except ImportError as error:
            raise BackendError(
                "--index",
                expected="the package httpx2",
                found="none",
                remedy='pip install "lexsplat[library]"',
            ) from error
        if not url.startswith(("http://", "https://")):
            raise LibraryError(f"--index {url}", expected="an address such as http://localhost:8000")
        self.url, self._prefix = url.rstrip("/"), f"lexsplat-{library}-"
        limits = httpx2.Timeout(ANSWER_SECONDS, connect=CONNECT_SECONDS)
        # Certificates are read for an address that has one: they take longer than most answers.
        self._client = httpx2.Client(timeout=limits, verify=url.startswith("https://"))
        self._errors = (httpx2.ConnectError, httpx2.ConnectTimeout), httpx2.TimeoutException, httpx2.HTTPError
        self._mending = command("verify", root, "--repair", "--index", self.url)
        self._known = False

    def check(self) -> None:
        """Refuse a server that is not there or has another API; asked once."""
        if self._known:
            return
        version = self._ask("GET", "/version")
        if not isinstance(version, str) or not version.startswith(VERSION):
            raise LibraryError(
                self.url,
                expected=f"Chroma with API {VERSION}x",
                found=repr(version)[:60],
                remedy="use Chroma 1",
            )
        self._known = True

    def put(self, record: Record, codes: Codes, stage: Path) -> None:
        """Store the codes of a scene in place of those of an earlier version."""
        place = self._collection(record)
        self._mark(_CHANGING)
        self._delete(place, {"where": {"scene": record.name}})
        self._upsert(place, [(record, codes)])
        self._mark(listing(stage))

    def drop(self, record: Record, stage: Path) -> None:
        """Delete the codes of a scene."""
        self._mark(_CHANGING)
        for each in self._collections():
            self._delete(each.place, {"where": {"scene": record.name}})
        self._mark(listing(stage))

    def groups(self, stage: Path, groups: Set[str]) -> list[Collection]:
        """The collections.

        Args:
            stage: The folder of the entries of the library.
            groups: The groups of its scenes.

        Raises:
            LibraryError: If the server holds another state of the library.
        """
        found = self._collections()
        problem = self._problem(found, stage, groups)
        if problem:
            expected = "the scenes of the library as they are now"
            raise LibraryError(self.url, expected=expected, found=problem, remedy=self._mending)
        return found

    def is_current(self, stage: Path, groups: Set[str]) -> bool:
        """Whether the server holds what the library holds; arguments as of `groups`."""
        return not self._problem(self._collections(), stage, groups)

    def _problem(self, found: list[Collection], stage: Path, groups: Set[str]) -> str:
        states = {each.state for each in found}
        if _CHANGING in states:
            return "an interrupted change"
        if states - {listing(stage)} or groups - {each.group for each in found}:
            return "another state of it"
        counts = [(each.codes, int(self._ask("GET", f"{each.place}/count"))) for each in found]
        lost = [f"{there:,} of {written:,} codes" for written, there in counts if written != there]
        return lost[0] if lost else ""

    def nearest(self, place: str, texts: Tensor, count: int) -> tuple[list[str], float]:
        """The scenes with the codes that fit texts ``[P, D]`` best.

        Args:
            place: The collection.
            texts: Unit embeddings.
            count: Number of codes for each text.

        Returns:
            Their names, each once, and an upper limit for the bounds of the others; minus infinity if there are none.
        """
        asked = torch.cat([texts.cpu().float(), torch.tensor([[1.0, 0.0]]).expand(len(texts), 2)], dim=1)
        body = {
            "query_embeddings": asked.tolist(), "n_results": count, "include": ["metadatas", "distances"],
        }  # fmt: skip
        found = self._ask("POST", f"{place}/query", body)
        names = list(dict.fromkeys(each["scene"] for row in found["metadatas"] for each in row))
        last = [1 - row[-1] for row in found["distances"] if len(row) == count]  # distance is 1 - product
        return names, max(last, default=-math.inf)

    def repair(self, entries: Iterable[tuple[Record, Codes]], stage: Path) -> None:
        """Upload the scenes that the server lacks, and delete codes of scenes that the library does not hold."""
        wanted: dict[str, list[tuple[Record, Codes]]] = {}
        places: dict[str, str] = {}
        for record, codes in entries:
            place = places.get(record.group) or places.setdefault(record.group, self._collection(record))
            wanted.setdefault(place, []).append((record, codes))
        self._mark(_CHANGING)
        for place in (each.place for each in self._collections()):
            there, lacking = set(self._identifiers(place)), []
            for record, codes in wanted.get(place, []):
                own = {_identifier(record, int(code)) for code in code_vectors(codes)[0]}
                if not own <= there:
                    lacking.append((record, codes))
                there -= own
            self._upsert(place, lacking)
            strays = sorted(there)
            for start in range(0, len(strays), _BATCH):
                self._delete(place, {"ids": strays[start : start + _BATCH]})
        self._mark(listing(stage))

    # -- the API

    def _collection(self, record: Record) -> str:
        """The place of the collection of the scene's encoder; made if there is none."""
        known = [each.place for each in self._collections() if each.group == record.group]
        if known:
            return known[0]
        facts = {"clip": record.clip, "state": _CHANGING, "codes": -1}
        name = f"{self._prefix}{record.group}"
        body = {"name": name, "get_or_create": True, "metadata": facts, "configuration": {"hnsw": _HNSW}}
        return f"{_PLACE}/{self._ask('POST', _PLACE, body)['id']}"

    def _collections(self) -> list[Collection]:
        """The collections of the library."""
        self.check()
        found = []
        for each in self._ask("GET", f"{_PLACE}?limit=10000"):
            if each["name"].startswith(self._prefix):
                group, facts = each["name"][len(self._prefix) :], each.get("metadata") or {}
                state, codes = str(facts.get("state")), facts.get("codes")
                codes = codes if isinstance(codes, int) else -1
                found.append(Collection(f"{_PLACE}/{each['id']}", group, state, codes))
        return found

    def _mark(self, state: str) -> None:
        for each in self._collections():
            codes = -1 if state == _CHANGING else int(self._ask("GET", f"{each.place}/count"))
            self._ask("PUT", each.place, {"new_metadata": {"state": state, "codes": codes}})

    def _upsert(self, place: str, entries: Iterable[tuple[Record, Codes]]) -> None:
        """Store the codes of scenes, those of many small ones in one request."""
        rows = (
            (_identifier(record, int(code)), vector.tolist(), {"scene": record.name})
            for record, codes in entries
            for code, vector in zip(*code_vectors(codes))
        )
        while some := list(islice(rows, _BATCH)):
            ids, vectors, scenes = zip(*some)
            self._ask("POST", f"{place}/upsert", {"ids": ids, "embeddings": vectors, "metadatas": scenes})

    def _delete(self, place: str, which: Mapping[str, Any]) -> None:
        self._ask("POST", f"{place}/delete", dict(which))

    def _identifiers(self, place: str) -> Iterator[str]:
        start = 0
        while True:
            page = self._ask("POST", f"{place}/get", {"limit": _PAGE, "offset": start, "include": []})["ids"]
            yield from page
            if len(page) < _PAGE:
                return
            start += _PAGE

    def _ask(self, method: str, path: str, body: Any = None) -> Any:
        """The JSON that the server answers."""
        absent, late, other = self._errors
        remedy = f"the library is whole: fix the server, then run {self._mending}"
        try:
            answer = self._client.request(method, f"{self.url}/api/v2{path}", json=body)
            if answer.is_success:
                return answer.json()
            found = f"status {answer.status_code} {answer.text[:160]}".strip()
        except absent:
            found = "no connection"
            port = f" --port {number}" if (number := urlsplit(self.url).port) else ""
            remedy = (
                f"start it (chroma run --path FOLDER{port}), or leave --index out to compare with all scenes"
            )
        except late:
            found = f"no answer within {ANSWER_SECONDS:.0f} seconds"
        except (other, ValueError) as error:
            found = str(error)[:160] or type(error).__name__
        raise LibraryError(self.url, expected="an answer of Chroma 1", found=found, remedy=remedy)


def _identifier(record: Record, code: int) -> str:
    return f"{record.name}/{record.content}/{code}"

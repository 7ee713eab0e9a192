"""SOG of version 1 and streamed SOG, as other programs write them."""

from __future__ import annotations

import json
import zipfile

import numpy as np
import pytest
from support.sog_files import write_streamed, write_version_1

from lexsplat.pipeline.splats import existing_splats
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.reading import read_splats


@pytest.mark.parametrize("zipped", [False, True])
def test_version_1_has_the_values_between_its_bounds(tmp_path, zipped):
    expected = write_version_1(tmp_path / "unbundled")
    path = tmp_path / "unbundled"
    if zipped:
        path = tmp_path / "a.sog"
        with zipfile.ZipFile(path, "w") as archive:
            for part in (tmp_path / "unbundled").iterdir():
                archive.write(part, part.name)
    found = read_splats(path)
    assert len(found) == 10
    assert found.sh_degree == 1
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(found, name), values, atol=2e-5, rtol=1e-5, err_msg=name)


def test_versions_of_the_future_and_wrong_bounds_are_refused(tmp_path):
    write_version_1(tmp_path)
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps(meta | {"version": 3}))
    with pytest.raises(FileFormatError, match="expected SOG of version 1 or 2, found version 3"):
        read_splats(tmp_path)
    meta["scales"]["mins"] = [0, 0]
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(FileFormatError, match="damaged content"):
        read_splats(tmp_path)


def leaf(*levels: tuple[int, int, int, int]) -> dict:
    return {"lods": {str(lod): {"file": f, "offset": o, "count": c} for lod, f, o, c in levels}}


def test_the_finest_level_of_every_region_of_a_streamed_sog_is_read(tmp_path):
    """One region at both levels, the second half of a file; another at the coarse level only; and a sky."""
    tree = {"children": [leaf((1, 1, 0, 3), (0, 0, 4, 6)), leaf((1, 1, 3, 2))]}
    write_streamed(tmp_path, {"0_0": 10, "1_0": 5}, tree, environment="sky/meta.json")
    sky = write_version_1(tmp_path / "sky", 2, seed=7)["means"]
    fine, coarse = (write_version_1(tmp_path / f"{n}_0", c, n)["means"] for n, c in ((0, 10), (1, 5)))
    for path in (tmp_path, tmp_path / "lod-meta.json"):
        found = read_splats(path)
        np.testing.assert_allclose(found.means, np.concatenate([fine[4:], coarse[3:], sky]), rtol=1e-5)
    assert existing_splats(tmp_path) == tmp_path / "lod-meta.json"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tree": leaf((0, 0, 5, 6))}, "expected 11 Gaussians in file 0, found 10"),
        ({"tree": leaf((0, 3, 0, 1))}, "file 3 of 1"),
        ({"tree": leaf((0, 0, -1, 1))}, "a range"),
        ({"tree": {}}, "at least one Gaussian"),
        ({"version": 2}, "version 2"),
        ({"filenames": ["../outside/meta.json"]}, "no part"),
        ({"filenames": ["missing/meta.json"]}, "no part"),
    ],
)
def test_a_streamed_sog_that_lacks_something_is_refused(tmp_path, change, words):
    write_version_1(tmp_path / "outside")
    write_streamed(tmp_path / "a", {"0_0": 10}, leaf((0, 0, 0, 10)))
    assert len(read_splats(tmp_path / "a")) == 10
    meta = json.loads((tmp_path / "a" / "lod-meta.json").read_text())
    (tmp_path / "a" / "lod-meta.json").write_text(json.dumps(meta | change))
    with pytest.raises(FileFormatError, match=words):
        read_splats(tmp_path / "a")

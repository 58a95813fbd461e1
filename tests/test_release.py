"""Versions agree, links of README.md lead somewhere; release.py builds archives and tries them."""

import re

from release import ROOT, released, tracked, with_links

import diffsim_ti as ds

URL = "https://example.org/owner/name"


def test_all_name_one_version():
    said = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.M)[1]
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)[1]
    assert said == ds.__version__ and newest in (ds.__version__, "Unreleased")


def test_links_of_an_index_lead_to_files():
    text = with_links((ROOT / "README.md").read_text(), URL, ds.__version__)
    links = re.findall(r"(!?)\[[^\]]*\]\(([^)]+)\)", text)
    own = [(mark, link.removeprefix(URL)) for mark, link in links if link.startswith(URL)]
    assert len(own) > 20 and all(link.startswith(("https:", "#")) for _, link in links)
    for mark, link in own:
        kind, version, path = re.fullmatch(r"/(raw|blob)/v([^/]+)/([^#]+)(?:#.*)?", link).groups()
        assert (kind == "raw") == bool(mark) and version == ds.__version__ and (ROOT / path).is_file(), link


def test_a_release_holds_all_that_its_tests_need():
    names = released(tracked())
    assert {"tests/conftest.py", "tests/release.py", "assets/make_meshes.py", "pyproject.toml", "CITATION.cff"} <= names
    assert not any(name.startswith(".ci") for name in names)


def test_messages_name_the_bounds_of_torch():
    bounds = re.search(r'"(torch>=[^"]+)"', (ROOT / "pyproject.toml").read_text())[1]
    assert bounds in (ROOT / "diffsim_ti/torch_bridge/autograd.py").read_text()

"""The report of a run: one file that loads nothing, whose numbers are those of the run directory."""

from __future__ import annotations

import base64
import gzip
import hashlib
import importlib
import json
import re
import shlex
import shutil
from html.parser import HTMLParser
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from small import small_config, small_trainer

import pirl_rl
from pirl_rl import report
from pirl_rl.commands import report as command
from pirl_rl.configuration import save_config
from pirl_rl.errors import ArgumentError, RunError
from pirl_rl.evaluation.planes import planes_of
from pirl_rl.grid import GridSolver
from pirl_rl.problems import Reach1D
from pirl_rl.reports import page, write_report
from pirl_rl.run_directory import RunDirectory

DATA = Path(__file__).parent / "data"
LOADS = {"src", "href", "xlink:href", "srcset", "action", "formaction", "poster", "data", "background", "cite"}
"""Attributes by which a page loads or leads to something."""

DUBINS = ("+experiment=dubins", "+debug=default", "env.dt=0.1", "env.substeps=1", "evaluation.final=[success]")

CERTIFICATE = {
    "claims": {
        "success": {
            "method": "Clopper and Pearson 1934",
            "confidence": 0.95,
            "estimate": 0.34576,
            "lower": 0.3432844202999896,
            "upper": None,
            "samples": 100_000,
            "paths": 100_000,
            "holds": True,
            "sentences": ["It succeeds with probability at least 0.3433.", "It did.", "V is not refuted."],
            "numbers": {"value": 0.345305524151655},
        }
    },
    "starts": "starts drawn by UniformStates",
    "simulator": {"dt": 0.005, "substeps": 2, "crossing": "bridge"},
    "picked_from": 1,
    "seed": 0,
}
PROOF = {"holds": True, "method": "affine arithmetic", "boxes": 21_128, "seconds": 5.41, "mean": 0.5672222309409455}
PROOF |= {"best": 0.9949869437373761, "best_state": [1.9997992439749144]}
PROOF |= {f"share_at_least_{level:g}": 1 - level for level in (0.5, 0.8, 0.9)}
LIMIT = {"holds": True, "method": "affine arithmetic", "boxes": 12_179, "seconds": 1.9, "mean": 0.6543}
LIMIT |= {"lowest": 0.2871, "lowest_state": [-1.6], "margin": 0.0125, "resisted": {"interior": [[1.0, 0.0, 0.0]]}}
LIMIT |= {f"share_below_{level:g}": level / 2 for level in (0.5, 0.8, 0.9)}


class Page(HTMLParser):
    """The elements of a page with their attributes, its words, and the texts of its numbers, scripts and styles."""

    def __init__(self, path: Path):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.shown: list[tuple[dict[str, str | None], str]] = []
        self.code: list[tuple[dict[str, str | None], str]] = []
        self.style, self.words = "", ""
        self._open: list[tuple[str, list | None]] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.append((tag, attributes))
        texts = self.code if tag == "script" else self.shown if "data-source" in attributes else None
        if texts is not None:
            texts.append((attributes, ""))
        if tag not in ("img", "input", "meta"):
            self._open.append((tag, texts))

    def handle_endtag(self, tag):
        while self._open and self._open.pop()[0] != tag:
            pass

    def handle_data(self, data):
        tag, texts = self._open[-1] if self._open else ("", None)
        if texts is not None:
            texts[-1] = (texts[-1][0], texts[-1][1] + data)
        if tag == "style":
            self.style += data
        elif tag != "script":
            self.words += data

    @property
    def data(self) -> list[dict]:
        """What the scripts of the page draw, for each run."""
        return [json.loads(text) for attributes, text in self.code if attributes.get("class") == "data"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A run with one state that has all that a report can show."""
    path = tmp_path_factory.mktemp("reports") / "reach1d"
    shutil.copytree(DATA / "format1", path)
    summary = json.loads((path / "summary.json").read_text())
    words = {
        "verdict": "doubtful",
        "verdict_reason": "V is wrong <by> a bit.",
        "verdict_lines": "verdict  no\nnext  go",
    }
    (path / "summary.json").write_text(json.dumps(words | summary | {"value_max_error": float("nan")}))
    (path / "evaluation.json").write_text(
        json.dumps({"value_mse": 0.125, "unheard_of": 3, "settings": {"success": {}}})
    )
    networks = page.Contents.of(path, page.Budget(10**6, 10**6)).networks
    (path / "certificate.json").write_text(json.dumps(CERTIFICATE | {"networks": networks}))
    (path / "proof.json").write_text(json.dumps(PROOF | {"networks": "of another run"}))
    (path / "limit.json").write_text(json.dumps(LIMIT))
    (path / "figures").mkdir()
    for name in ("value", "calibration", "mine"):
        Image.new("RGB", (1600, 900), "white").save(path / "figures" / f"{name}.png")
    return path


@pytest.fixture(scope="module")
def drawn(folder) -> Path:
    return write_report([folder], folder / "report.html")


@pytest.fixture(scope="module")
def dubins(tmp_path_factory) -> Path:
    """A run with three states whose networks were not trained, without summary, metrics and figures."""
    path = tmp_path_factory.mktemp("reports") / "dubins"
    small_trainer(path, base=DUBINS).save()
    return path


@pytest.fixture(scope="module")
def planes(dubins, tmp_path_factory) -> Page:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "MAPS", 200_000)
        return Page(write_report([dubins], tmp_path_factory.mktemp("pages") / "dubins.html"))


def test_a_page_is_one_file_that_loads_nothing(drawn):
    assert drawn.stat().st_size <= page.LARGEST
    found = Page(drawn)
    leads = [(tag, name, value) for tag, found in found.tags for name, value in found.items() if name in LOADS]
    assert leads
    assert all(value.startswith(("#", "data:image/webp;base64,")) for _, _, value in leads)
    assert "@import" not in found.style
    assert "url(" not in found.style
    assert not [tag for tag, _ in found.tags if tag in ("link", "iframe", "object", "embed", "base")]
    [own] = [text for attributes, text in found.code if not attributes]
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|EventSource|import)\b", own)


def test_the_page_runs_its_own_scripts_alone(drawn):
    """Its policy names them by their hashes, so that not even a script that was smuggled in would run."""
    found = Page(drawn)
    [policy] = [entry["content"] for tag, entry in found.tags if tag == "meta" and "http-equiv" in entry]
    assert policy.startswith("default-src 'none'; ")
    [own] = [text for attributes, text in found.code if not attributes]
    [library] = [text for attributes, text in found.code if attributes.get("id") == "library"]
    for script in (own.encode(), gzip.decompress(base64.b64decode(library))):
        assert f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'" in policy
    assert "unsafe-inline" not in policy.partition("script-src")[2]


def test_every_number_is_that_of_its_file(drawn, folder):
    shown = Page(drawn).shown
    names = ("summary.json", "evaluation.json", "certificate.json", "proof.json", "limit.json")
    files = {name: json.loads((folder / name).read_text()) for name in names}
    assert {attributes["data-source"].partition(":")[0] for attributes, _ in shown} == {*files}
    for attributes, text in shown:
        file, _, key = attributes["data-source"].partition(":")
        entry = files[file]
        for name in [key] if key in entry else key.split("."):
            entry = entry[name]
        if isinstance(entry, str):
            assert text == entry
        elif isinstance(entry, list):
            assert attributes["value"] == str(entry)
        elif entry != entry:
            assert text == "not a number"
        else:
            assert float(attributes["value"]) == entry
            assert float(text.replace(",", "")) == pytest.approx(entry, rel=1e-4)
    every = {attributes["data-source"] for attributes, _ in shown}
    assert {f"summary.json:{name}" for name in files["summary.json"]} <= every


def test_the_page_says_what_there_is(drawn):
    words = Page(drawn).words
    for text in (
        *("doubtful", "V is wrong <by> a bit.", "dX = u dt + dW", "It succeeds with probability at least 0.3433."),
        *("not about continuous feedback", "made for other networks", "unheard_of", "class Reach1D"),
        *("python -m pirl_rl.report run=reach1d", "no record of the machine", "The figure mine."),
    ):
        assert text in words, text
    assert words.count("made for other networks") == 1  # of the proof, and not of the certificate
    # No function of the limit lies beside its numbers, from which the problem could be told.
    assert words.count("made for another problem") == 1
    assert "no policy succeeds with a probability above 0.2871" in words
    assert "The bound is raised by 0.0125" in words


def test_the_same_directory_gives_the_same_bytes(drawn, folder, tmp_path):
    again = write_report([str(folder)], tmp_path / "again.html")
    assert again.read_bytes() == drawn.read_bytes()


def unpacked(text: str, width: int) -> np.ndarray:
    """The numbers that `packed` wrote, by a decoder of its own."""
    planes = np.frombuffer(gzip.decompress(base64.b64decode(text)), np.uint8).reshape(width, -1).astype(int)
    steps = sum(256 ** (width - 1 - k) * plane for k, plane in enumerate(planes))
    return np.cumsum(steps) % 256**width


def test_curves_are_those_of_the_run(drawn, folder):
    """Half a step of the 65,535 that a number is rounded to, and single precision."""
    [data] = Page(drawn).data
    run, line = pirl_rl.load_run(folder), data["line"]
    x = np.linspace(line["low"], line["high"], line["points"])[:, None]
    values = unpacked(line["curves"]["value"], 2).reshape(len(line["taus"]), -1) / 65_535
    controls = -1 + 2 * unpacked(line["control"][0], 2).reshape(values.shape) / 65_535
    for k in (1, 40, 80):
        assert np.abs(values[k] - run.value(line["taus"][k], x)).max() < 2e-5
        assert np.abs(controls[k] - run.policy(line["taus"][k], x)[:, 0]).max() < 4e-5
    exact = unpacked(line["curves"]["exact"], 2).reshape(values.shape) / 65_535
    truth = run.problem.exact_value(torch.tensor(2.0, dtype=torch.float64), torch.from_numpy(x))
    assert np.abs(exact[80] - truth.numpy()).max() < 2e-5


def test_maps_are_those_of_the_run(planes, dubins):
    """Half a step of the 255 that a number is rounded to; both sets are where the problem says."""
    run = pirl_rl.load_run(dubins)
    [entry], [plane] = planes.data[0]["planes"], planes_of(run.solution).values()
    [further], [layer], side = entry["further"], entry["layers"], entry["side"]
    assert further["values"][further["start"]] == 0.0  # the heading of the plane
    shape = (len(entry["taus"]), len(further["values"]), side, side)
    values, controls = unpacked(layer["value"], 1).reshape(shape), unpacked(layer["control"][0], 1).reshape(shape)
    axes = [torch.linspace(a, b, side, dtype=torch.float64) for a, b in zip(plane.box.low, plane.box.high, strict=True)]
    grid = plane.embed(torch.stack(torch.meshgrid(*axes, indexing="xy"), -1))
    for t, level in ((3, 0), (shape[0] - 1, further["start"]), (shape[0] // 2, 2)):
        grid[..., 2] = further["values"][level]
        wanted = run.value(entry["taus"][t], grid).double()
        assert np.abs(values[t, level] / 255 - wanted.numpy()).max() < 0.5 / 255 + 1e-6
        wanted = run.policy(entry["taus"][t], grid)[..., 0].double()
        assert np.abs(-1.5 + 3 * controls[t, level] / 255 - wanted.numpy()).max() < 1.5 / 255 + 1e-6
        for name, inside in (("target", run.problem.reached(grid)), ("avoid", run.problem.failed(grid))):
            codes = unpacked(layer["sets"][name], 1).reshape(shape[1:])
            assert bool(inside.any())
            assert np.array_equal(codes[level] < 127.5, inside.numpy())


def test_paths_end_where_the_page_says(planes):
    data = planes.data[0]
    paths, [points] = data["paths"], data["paths"]["points"]
    assert paths["tau"] == sorted(paths["tau"], reverse=True)
    for place, end, step in zip(points, paths["ends"], paths["steps"], strict=True):
        distance = np.hypot(place[step][0] - 1.2, place[step][1])  # of the target, whose radius is 0.3
        assert (distance <= 0.31) == (end == "reached")


def test_a_run_without_anything_but_networks_has_a_page(planes):
    for text in ("not finished", "has no figures", "no statistical certificate", "recorded no curves", "no metrics"):
        assert text in planes.words, text
    assert not planes.shown


def test_runs_stand_side_by_side(folder, dubins, tmp_path, in_process):
    code, printed = in_process(report)(f"run=[{folder},{dubins}]", f"run={folder}", f"out={tmp_path / 'three.html'}")
    assert code == 0, printed
    found = Page(tmp_path / "three.html")
    assert (tmp_path / "three.html").stat().st_size <= page.LARGEST
    assert [len(data.get("planes", ())) for data in found.data] == [0, 1, 0]
    sections = [entry["id"] for tag, entry in found.tags if tag == "section" and "id" in entry]
    assert len([tag for tag, entry in found.tags if tag == "article"]) == 3 * len(sections)
    places = [entry["id"] for _, entry in found.tags if "id" in entry]
    assert len(places) == len({*places})
    assert not (dubins / "report.html").exists()


HOSTILE = '''
import torch

from pirl_rl import Box, ReachAvoidProblem


class Evil(ReachAvoidProblem):
    """</script><script>alert(1)</script><img src=x onerror=alert(2)>"""

    horizon = 1.0
    states, controls = Box([-1.0], [1.0]), Box([-1.0], [1.0])
    state_names, control_names = ("<img src=x onerror=alert(3)> (m)",), ('"><script>alert(4)</script>_1',)

    def drift(self, x, u):
        return u

    def diffusion(self, x, u):
        return torch.ones_like(x).unsqueeze(-1)

    def target_level(self, x):
        return 0.9 - x[..., 0]
'''


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A run of a problem in a user's own module, whose every name would break a page that does not escape it."""
    folder = tmp_path_factory.mktemp("hostile")
    (folder / "hostile_module.py").write_text(HOSTILE)
    path = folder / "a <img src=x onerror=alert(5)> run"
    steps = {"env": {"dt": 0.1, "substeps": 1}, "updates": 1, "evaluation": {"final": []}}
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        module = importlib.import_module("hostile_module")
        pirl_rl.train(module.Evil, folder=path, debug="default", report=True, **steps)
        yield path


def test_training_ends_with_the_page_that_the_command_draws(hostile, in_process):
    first = (hostile / "report.html").read_bytes()
    code, printed = in_process(report)(f"run={hostile}")
    assert code == 1
    assert "hostile_module" in printed  # a run directory may not import what it names
    (hostile / "report.html").unlink()
    code, printed = in_process(report)(f"run={hostile}", "trust=[hostile_module]")
    assert code == 0, printed
    assert (hostile / "report.html").read_bytes() == first
    words = Page(hostile / "report.html").words
    assert "python -m pirl_rl.train +experiment=own +debug=default" in words
    assert f"python -m pirl_rl.report {shlex.quote(f'run={hostile.name}')} 'trust=[hostile_module]'" in words
    [session] = json.loads(RunDirectory(hostile).machine.read_text())["sessions"]
    assert session["torch"] == version("torch")
    assert session["processor"] in words


def test_names_of_users_are_text(hostile, tmp_path):
    summary = json.loads((hostile / "summary.json").read_text())
    summary |= {"<script>alert(6)</script>": 1.0, "verdict": "<b>solved</b>"}
    (hostile / "summary.json").write_text(json.dumps(summary))
    found = Page(write_report([hostile], tmp_path / "page.html", ["hostile_module"]))
    assert [k for k in range(1, 7) if f"alert({k})" not in found.words] == []
    assert sorted(attributes.get("type", "") for attributes, _ in found.code) == ["", "application/json", "text/plain"]
    assert not [entry for _, entry in found.tags if any(name.startswith("on") for name in entry)]
    assert "<" not in found.data[0]["line"]["label"]


def test_a_report_that_fails_costs_one_sentence(folder, monkeypatch, capsys):
    def broken(*arguments):
        raise RuntimeError("no\npage")

    monkeypatch.setattr(command, "write_report", broken)
    command.draw_again(folder)
    told = capsys.readouterr()
    assert told.err == "drawing the report\nwarning: the report was not drawn, RuntimeError: no\n"
    assert not told.out


def test_a_grid_has_a_page(tmp_path):
    save_config(small_config("method=grid"), tmp_path)
    GridSolver(Reach1D(), 21, estimate=False).solve().save(RunDirectory(tmp_path).grid)
    (tmp_path / "summary.json").write_text('{"grid_nodes": 25.0}')
    found = Page(write_report([tmp_path], tmp_path / "report.html"))
    assert "a grid is solved" in found.words
    assert "The number of nodes of the mesh." in found.words
    assert {"line", "paths"} <= found.data[0].keys()


@pytest.mark.parametrize("name", ["summary.json", "certificate.json", "metrics.csv", "figures/value.png"])
def test_a_broken_file_is_named_and_the_old_page_stays(name, folder, drawn, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / name).write_text("update\nmany\n" if name.endswith("csv") else "[1]")
    before = (copy / "report.html").read_bytes()
    with pytest.raises(RunError, match=re.escape(str(copy / Path(name).parts[0]))):
        write_report([copy], copy / "report.html")
    assert (copy / "report.html").read_bytes() == before
    assert not list(copy.glob(".*draft"))


def test_a_certificate_that_lacks_an_entry_is_one_sentence(folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "certificate.json").write_text(json.dumps(CERTIFICATE | {"claims": {"success": {"holds": True}}}))
    message = r"expected all entries of certificate\.json or proof\.json or limit\.json, .*sentences"
    with pytest.raises(RunError, match=message):
        write_report([copy], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_a_page_is_made_smaller_until_it_fits(folder, tmp_path, monkeypatch):
    whole = write_report([folder], tmp_path / "page.html").stat().st_size
    monkeypatch.setattr(page, "LARGEST", whole - 1)
    monkeypatch.setattr(page, "SHARES", (1.0, 1e-3))
    assert write_report([folder], tmp_path / "page.html").stat().st_size < whole
    assert "Not shown, since the page would be too large" in Page(tmp_path / "page.html").words
    monkeypatch.setattr(page, "LARGEST", 1_000)
    with pytest.raises(RunError, match="expected a page of at most 1,000 bytes"):
        write_report([folder], tmp_path / "other.html")


def test_a_link_that_leads_out_is_refused(folder, tmp_path, in_process):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "figures" / "secret.png").symlink_to(DATA / "drift_golden.npz")
    code, printed = in_process(report)(f"run={copy}")
    assert code == 1
    assert "secret.png: expected no link that leads out of the run directory" in printed


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "run: expected run=RUN_DIR"),
        (["run=a", "run=b"], "out: expected out=FILE for the report of 2 runs"),
        (["run=a", "form=b"], "form=b: expected key=value with a key out of run, out, trust"),
        (["run=nowhere"], "nowhere is not a run directory"),
    ],
)
def test_mistakes_are_one_sentence(arguments, told, in_process):
    code, printed = in_process(report)(*arguments)
    assert code == 1
    assert told in printed
    assert "Traceback" not in printed


def test_too_many_runs_are_refused(folder, tmp_path):
    with pytest.raises(ArgumentError, match="expected 1 to 6 run directories, got 7"):
        write_report([folder] * 7, tmp_path / "page.html")

"""The report: complete, self-contained, and right in a real browser."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from click.testing import CliRunner

import polinfer
from acquisition import write_report
from acquisition.cli import report_command
from polinfer import ComplexGain, Model, PolariserFirst, phantoms, save

STATES = np.stack([np.ones(3), np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)

LABELS = (np.arange(54).reshape(6, 9) % 9 > 4).astype(int)


def records(folder, model, shape=(6, 9)):
    scene = phantoms.lesion(shape, rng=0)
    data = polinfer.simulate(model, scene.parameters, STATES, 0.02, rng=1, gain=scene.gain)
    save(data, folder / "measurement.nc")
    save(polinfer.fit(model, data), folder / "fit.nc")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    records(folder, Model(gain=ComplexGain(1.0)))
    return write_report(folder, title="A <b>test</b>", seconds={"fit": 1.5, "rest": 2.0}, draws=40, simulations=3,
                        pixel_size=4e-6, notes=("A note & more.",), labels=LABELS)  # fmt: skip


def test_it_holds_everything_and_asks_for_nothing(page):
    """All sections, and in them the page's number of the retardance angle's contrast as the library has it."""
    text = page.read_text()
    angle = polinfer.load(page.parent / "fit.nc").parameters.retardance_angle
    row = re.search(r"<h2>Contrast</h2>.*?<td>retardance angle</td><td class=.number.>(.*?)</td>", text, re.S)
    assert float(row[1]) == pytest.approx(polinfer.contrast.cnr(angle, LABELS, period=np.pi, rng=0).value, rel=1e-3)
    for title in ("Summary", "Maps", "Amplitude and phase", "What the data do not tell", "Posterior of three pixels",
                  "Retarder first or polariser first?", "Texture", "Contrast", "Timings", "Provenance"):  # fmt: skip
        assert f"<h2>{title}</h2>" in text
    assert "A &lt;b&gt;test&lt;/b&gt;" in text  # what is given is text, never markup
    assert "A note &amp; more." in text
    assert "Verdict of the whole frame: " in text
    assert re.search(r"Of 3 simulated scenes .* % gave the right verdict", text)
    assert "SHA-256" in text
    assert "3.5" in text  # seconds together
    assert text.count("data:image/png;base64,") == 7
    assert not re.search(r"(src|href)=.(?!data:)", text)
    assert "<script" not in text
    assert not re.search(r">\s*-?(nan|inf)\b", text)


@pytest.mark.parametrize("width", [360, 1200])
def test_a_browser_shows_it_without_errors_at_any_width(page, width, tmp_path):
    """All pictures are there, nothing is wider than the window, the text is large enough to be read, no errors."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium is installed (.ci/run installs it)")
    probe = """<script>window.onload = () => { document.title = JSON.stringify({
      pictures: [...document.images].map(i => i.complete && i.naturalWidth > 100),
      page: document.documentElement.scrollWidth, window: window.innerWidth,
      text: parseFloat(getComputedStyle(document.querySelector("p")).fontSize)})}</script></body>"""
    probed = tmp_path / "probed.html"
    probed.write_text(page.read_text().replace("</body>", probe))
    done = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync",
         "--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}",
         f"--window-size={width},900", "--virtual-time-budget=5000", "--dump-dom", probed.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    found = json.loads(re.search(r"<title>(.*?)</title>", done.stdout)[1].replace("&quot;", '"'))
    assert found["pictures"] == [True] * 7
    assert found["page"] <= found["window"]
    assert found["text"] >= 14
    assert "CONSOLE" not in done.stderr


@pytest.mark.slow
def test_other_models_and_the_command(tmp_path):
    records(tmp_path, Model(ordering=PolariserFirst(), gain=ComplexGain(1.0)), shape=(2, 3))
    found = CliRunner().invoke(report_command, [str(tmp_path), "--simulations", "0", "--title", "Small"])
    assert found.exit_code == 0, found.output
    text = (tmp_path / "report.html").read_text()
    assert "<h2>Texture</h2>" not in text  # too small for a window
    assert "was not simulated" in text


def test_what_is_missing_or_foreign_is_named(tmp_path):
    found = CliRunner().invoke(report_command, [str(tmp_path)])
    assert found.exit_code == 1
    assert "measurement.nc" in found.output
    scene = phantoms.lesion((4, 4), rng=0)
    data = polinfer.simulate(Model(), scene.parameters, STATES, 0.02, rng=1)
    save(data, tmp_path / "measurement.nc")
    save(data, tmp_path / "fit.nc")
    found = CliRunner().invoke(report_command, [str(tmp_path)])
    assert "fit.nc" in found.output


def test_labels_must_hold_two_regions(tmp_path):
    records(tmp_path, Model(gain=ComplexGain(1.0)))
    with pytest.raises(ValueError, match="labels must hold"):
        write_report(tmp_path, tmp_path / "other.html", labels=np.zeros((6, 9), int), simulations=0, draws=8)

"""``uvgs camera convert``, ``diff`` and ``check`` from the outside: files, figures, exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from uvgs_bench.camera import Calibration, Lens
from uvgs_bench.camera.calibration import Verdict
from uvgs_bench.cli.app import main
from uvgs_bench.devices.sim.bench import true_lens
from uvgs_bench.devices.sim.board_views import SimulatedBoardSource
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.store.boards import read_board
from uvgs_bench.store.calibrations import read_calibration, write_calibration

pytestmark = pytest.mark.opencv

BOARD = Path(__file__).parents[2] / "calib" / "boards" / "chessboard_9x6.toml"
FOV = [608.8073, 607.61439, 632.53684, 549.08386, 0.998693]


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    return int(left.value.code or 0)


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_a_refit_follows_a_lens_only_as_far_as_it_is_known(tmp_path, capsys):
    wide = Lens("plumb_bob", 1280, 960, np.array([700.0, 700.0, 640.0, 480.0, -0.25, 0.06, 0.0, 0.0, 0.0]))
    verdict = Verdict("usable_within_radius", 300.0, ("boards were seen no farther out",))
    worst = {}
    for name, judged in (("whole", None), ("within", verdict)):
        path = tmp_path / f"{name}.yaml"
        write_calibration(path, Calibration(wide, name, np.eye(9) * 1e-9, 0.2, verdict=judged))
        target = tmp_path / f"{name}.txt"
        assert run("camera", "convert", path, target, "--refit", "fov", "--json") == 0
        done = json.loads(capsys.readouterr().out)
        worst[name] = done["max_px"]
        # A disc of 300 px in a picture of 1280x960 px is 23 % of it.
        assert done["covered_share"] == pytest.approx(1.0 if judged is None else 0.23, abs=0.02)
    assert worst["within"] < 0.2 * worst["whole"]


@pytest.fixture
def navcam(tmp_path) -> Path:
    path = tmp_path / "navcam.yaml"
    covariance = np.diag([1.0, 1.0, 0.5, 0.5, 1e-6])
    write_calibration(path, Calibration(Lens("fov", 1280, 960, np.array(FOV)), "navcam", covariance, 0.2))
    return path


def test_there_and_back_again_keeps_every_digit(navcam, tmp_path, capsys):
    for name, to in (("a.yaml", "kalibr"), ("b.lua", ""), ("c.txt", ""), ("d.yaml", "")):
        assert run("camera", "convert", navcam, tmp_path / name, *(["--to", to] if to else [])) == 0
        printed = capsys.readouterr().out
        assert "exact" in printed
        assert name in printed
        assert ("no place for the covariance" in printed) == (name != "d.yaml")
        back = tmp_path / f"back_{name}.yaml"
        assert run("camera", "convert", tmp_path / name, back) == 0
        # COLMAP's half pixel may round once on the way there and once back.
        np.testing.assert_allclose(read_calibration(back).lens.parameters, FOV, rtol=0, atol=2.3e-13)
        capsys.readouterr()
    assert read_calibration(tmp_path / "d.yaml").covariance is not None
    assert read_calibration(tmp_path / "back_a.yaml.yaml").covariance is None


def test_what_has_no_exact_form_is_refused_until_a_refit_is_asked_for(navcam, tmp_path, capsys):
    out = tmp_path / "navcam.cameramodel"
    assert run("camera", "convert", navcam, out) == 4
    said = capsys.readouterr().err
    assert "a mrcal cameramodel has no form for fov" in said
    assert "--refit plumb_bob or rational_polynomial or thin_prism" in said
    assert not out.exists()
    assert run("camera", "convert", navcam, out, "--refit", "rational_polynomial", "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["exact"] is False
    # What eight coefficients can do for this 150 degree lens, found by hand: hundredths of a pixel.
    assert 1e-4 < figures["rms_px"] < figures["max_px"] < 0.5
    assert "refitted from fov: RMS 0.0" in out.read_text()
    assert run("camera", "convert", navcam, out, "--refit", "rational_polynomial") == 2
    assert "--force" in capsys.readouterr().err
    # Five coefficients fold over inside this field; that is no calibration.
    assert run("camera", "convert", navcam, out, "--refit", "plumb_bob", "--force") == 4
    assert "no plumb_bob lens covers the field" in capsys.readouterr().err


def test_refitting_for_a_format_without_k3_keeps_it_zero(tmp_path, capsys):
    source, out = tmp_path / "c.yaml", tmp_path / "k.yaml"
    lens = Lens("plumb_bob", 640, 480, np.array([600.0, 601.0, 320.0, 240.0, -0.2, 0.1, 1e-3, -1e-3, -0.05]))
    write_calibration(source, Calibration(lens, "c"))
    assert run("camera", "convert", source, out, "--to", "kalibr") == 4
    assert "no place for k3 of plumb_bob" in capsys.readouterr().err
    assert run("camera", "convert", source, out, "--to", "kalibr", "--refit", "plumb_bob") == 0
    assert "at most 0." in capsys.readouterr().out
    assert "radtan" in out.read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["none.yaml", "out.yaml"], 4, "no such file"),
        (["navcam.yaml", "out.xyz"], 2, "names no format"),
        (["navcam.yaml", "out.yaml", "--to", "matlab"], 2, "unknown format 'matlab'"),
        (["navcam.yaml", "out.yaml", "--camera", "other"], 2, "no camera 'other'"),
        (["navcam.yaml", "out.yaml", "--size", "large"], 2, "no picture size"),
        (["navcam.yaml", "out.yaml", "--refit", "pinhole"], 4, "unknown lens model"),
    ],
)
def test_mistakes_are_one_line(navcam, tmp_path, capsys, arguments, code, said):
    source, out, *rest = arguments
    assert run("camera", "convert", tmp_path / source, tmp_path / out, *rest) == code
    assert said in capsys.readouterr().err
    assert not (tmp_path / out).exists()


def test_one_of_several_cameras_is_asked_for(tmp_path, capsys):
    chain = tmp_path / "chain.yaml"
    one = "  camera_model: pinhole\n  distortion_coeffs: [0.93]\n  distortion_model: fov\n"
    one += "  intrinsics: [612.4, 611.9, 640.8, 479.5]\n  resolution: [1280, 960]\n"
    chain.write_text(f"cam0:\n{one}cam1:\n{one.replace('0.93', '0.94')}")
    assert run("camera", "convert", chain, tmp_path / "o.yaml") == 2
    assert "expected one of cam0, cam1" in capsys.readouterr().err
    assert run("camera", "convert", chain, tmp_path / "o.yaml", "--camera", "cam1") == 0
    assert read_calibration(tmp_path / "o.yaml").lens.parameters[4] == 0.94


def test_difference_is_a_table_an_object_and_a_picture(navcam, tmp_path, capsys):
    other = tmp_path / "other.yaml"
    covariance = np.diag([1.0, 1.0, 0.5, 0.5, 1e-6])
    lens = Lens("fov", 1280, 960, np.add(FOV, [0.6, 0.6, 0.0, 0.0, 0.0]))
    write_calibration(other, Calibration(lens, "other", covariance, 0.2))
    picture = tmp_path / "map.png"
    assert run("camera", "diff", navcam, other, "--picture", picture) == 0
    printed = capsys.readouterr().out
    assert "worst" in printed
    assert "times that" in printed
    assert "map.png" in printed
    image = cv2.imread(str(picture))
    # A map, not a blank sheet.
    assert image.std() > 20.0
    assert run("camera", "diff", navcam, other, "--picture", picture) == 2
    assert "--force" in capsys.readouterr().err
    assert run("camera", "diff", navcam, other, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    # A thousandth of the focal length, at most 855 px from the principal point.
    assert 0.5 < found["max_px"] < 0.9
    assert found["centre_px"] < found["rms_px"] < found["max_px"]
    assert found["predicted_rms_px"] > 0.0
    assert np.shape(found["shift_px"]) == (*np.shape(found["sigma_px"]), 2)


def test_difference_of_different_cameras_is_refused(navcam, tmp_path, capsys):
    other = tmp_path / "other.yaml"
    write_calibration(other, Calibration(Lens("fov", 640, 480, np.array([300, 300, 320, 240, 0.9])), "other"))
    assert run("camera", "diff", navcam, other) == 4
    assert "640x480" in capsys.readouterr().err


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> tuple[Path, Lens]:
    """New pictures by the simulated camera."""
    truth = SimulatedTruth()
    source = SimulatedBoardSource(truth, read_board(BOARD), 12, seed=9)
    folder = tmp_path_factory.mktemp("new")
    for capture in source:
        assert cv2.imwrite(str(folder / f"{capture.source}.png"), capture.image)
    return folder, true_lens(truth)


@pytest.mark.parametrize(("factor", "code", "word"), [(1.0, 0, "OK"), (1.02, 1, "DEGRADED")])
def test_check_says_what_changed_by_its_exit_code(photographs, tmp_path, capsys, factor, code, word):
    folder, lens = photographs
    parameters = lens.parameters.copy()
    parameters[:2] /= factor
    path = tmp_path / "old.yaml"
    # 0.1 px is what corners of this simulated camera are good for, uneven light and all.
    doubt = np.diag(np.full(parameters.size, 1e-8))
    write_calibration(path, Calibration(lens.with_parameters(parameters), "old", doubt, 0.1, 0.1))
    assert run("camera", "check", path, f"images:{folder}", "--board", BOARD, "--quiet") == code
    assert word in capsys.readouterr().out
    assert run("camera", "check", path, f"images:{folder}", "--board", BOARD, "--quiet", "--json") == code
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"].upper() == word
    focal = next(figure for figure in found["figures"] if figure["name"] == "focal length")
    # The second time nothing is searched; the answers above are the same from what was kept.
    assert len(list((tmp_path / "cache" / "uvgs_bench" / "boards").glob("*.json"))) == 12
    # 2 % planted; 0.1 % is five times what twelve views tell.
    assert focal["value"] == pytest.approx(100.0 * (factor - 1.0), abs=0.1)


def test_check_with_too_few_views_is_inconclusive(photographs, tmp_path, capsys):
    folder, lens = photographs
    path = tmp_path / "old.yaml"
    write_calibration(path, Calibration(lens, "old"))
    source = f"images:{folder}?glob=view_0[01].png"
    assert run("camera", "check", path, source, "--board", BOARD) == 3
    assert "need 3" in capsys.readouterr().err


def test_show_makes_a_page_of_a_camera_file_alone(navcam, tmp_path, capsys):
    beacon = BOARD.parents[1] / "beacons" / "tetra_small.toml"
    assert run("camera", "show", navcam, "--beacon", beacon) == 0
    assert "calibrate again" in " ".join(capsys.readouterr().out.split())
    page = tmp_path / "page"
    assert run("camera", "show", navcam, "--beacon", beacon, "--report", page, "--json") == 0
    assert json.loads(capsys.readouterr().out)["report"]["html"] == str(page / "report.html")
    data = json.loads((page / "report.json").read_text(encoding="utf-8"))
    assert data["verdict"]["state"] == "none"
    # Without the joint covariance nothing is known about projections and poses.
    assert [s["key"] for s in data["sections"]] == ["lens", "definitions"]
    assert run("camera", "show", navcam, "--report", page) == 2
    assert "--force" in capsys.readouterr().err
    assert run("camera", "show", navcam, "--report", navcam) == 2
    assert "expected a folder" in capsys.readouterr().err

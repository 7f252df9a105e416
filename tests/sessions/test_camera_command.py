"""``uvgs camera convert``, ``diff`` and ``check`` from the outside: files, figures, exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.camera import Calibration, Lens
from uvgs_bench.cli.app import main
from uvgs_bench.store.calibrations import read_calibration, write_calibration

pytestmark = pytest.mark.opencv

FOV = [608.8073, 607.61439, 632.53684, 549.08386, 0.998693]


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    return int(left.value.code or 0)


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

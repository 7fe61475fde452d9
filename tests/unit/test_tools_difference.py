"""The pure parts of the study of difference maps: where a peak lies, noise, signal to noise; and a small study."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from nlos_cam.objects.placement import object_depth
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene

TOOLS = Path(__file__).parents[2] / "tools"
BIN_M, SIGMA_M = 0.01, 0.299792458 / np.sqrt(8 * np.log(2))


@pytest.fixture(autouse=True)
def _tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(TOOLS)


@pytest.fixture
def waveform() -> ModuleType:
    return importlib.import_module("difference_waveform")


@pytest.fixture
def scenes() -> ModuleType:
    return importlib.import_module("difference_scenes")


@pytest.fixture
def noise() -> ModuleType:
    return importlib.import_module("difference_noise")


@pytest.fixture
def snr() -> ModuleType:
    return importlib.import_module("difference_snr")


def later_light(generator: np.random.Generator, path_m: np.ndarray, strength: float) -> np.ndarray:
    """Histograms (n, 300) of as much light as `strength`, all of it later than `path_m`."""
    after = (np.arange(300) + 0.5) * BIN_M > path_m[:, None]
    light = generator.random((len(path_m), 300)) * after
    return strength * light / light.sum(1, keepdims=True)


def searched(direct: float, path_m: float, later: np.ndarray) -> tuple[float, float]:
    """The highest peak by brute force: all path lengths in steps of 0.1 mm, then of 10 nm about the best."""

    def wave(at_m: np.ndarray) -> np.ndarray:
        echoes_m = np.append((np.arange(len(later)) + 0.5) * BIN_M, path_m)
        return np.exp(-0.5 * ((at_m[:, None] - echoes_m) / SIGMA_M) ** 2) @ np.append(later, direct)

    coarse_m = np.arange(0.0, 3.0, 1e-4)
    best_m = coarse_m[wave(coarse_m).argmax()]
    fine_m = best_m + np.arange(-2e-4, 2e-4, 1e-8)
    height = wave(fine_m)
    return float(fine_m[height.argmax()]), float(height.max())


def test_weak_later_light_shifts_the_peak_as_the_first_order_says(waveform: ModuleType) -> None:
    generator = np.random.default_rng(0)
    path_m, direct = generator.uniform(0.3, 1.5, 6), generator.uniform(0.5, 2.0, 6)
    later = later_light(generator, path_m, 0.01)
    shift_m = waveform.first_order(direct, path_m, later, BIN_M, waveform.gaussian_peak(1.0))
    found = np.array([searched(*one) for one in zip(direct, path_m, later, strict=True)])
    assert np.allclose(shift_m, found[:, 0] - path_m, rtol=0.02)
    assert shift_m.min() > 1e-5


def test_chips_shift_by_the_slope_of_their_peak_over_its_bend(waveform: ModuleType) -> None:
    """Against chips correlated by sums: a triangle smeared by a Gaussian; its top by a parabola of 6 mm."""
    chip_m, step_m = 0.299792458, 1e-4
    at_m = np.arange(-1.0, 1.0, step_m)
    smear = np.exp(-0.5 * (np.arange(-0.2, 0.2, step_m) / (0.3 * chip_m / 2.563)) ** 2)
    triangle = np.maximum(1 - np.abs(at_m) / chip_m, 0)
    peak = np.convolve(triangle, smear / smear.sum(), mode="same")
    peak /= peak.max()

    def top_m(wave: np.ndarray) -> float:
        about = slice(wave.argmax() - 30, wave.argmax() + 31)
        bow = np.polyfit(at_m[about], wave[about], 2)
        return float(-bow[1] / (2 * bow[0]))

    for bins in (5, 15, 22, 31):
        later = np.zeros((1, 80))
        later[0, 30 + bins] = 1e-3
        late_m = 0.005 + 0.01 * bins
        expected_m = top_m(peak + 1e-3 * np.interp(at_m - late_m, at_m, peak)) - top_m(peak)
        shift_m = waveform.first_order(np.ones(1), np.array([0.3]), later, BIN_M, waveform.chips_peak())
        assert shift_m[0] == pytest.approx(expected_m, rel=0.03)


@pytest.mark.parametrize("strength", [1e-4, 0.1, 3.0, 100.0])
def test_the_receiver_finds_the_highest_peak_whatever_the_strength(waveform: ModuleType, strength: float) -> None:
    generator = np.random.default_rng(1)
    path_m, direct = generator.uniform(0.3, 1.0, 6), np.ones(6)
    later = later_light(generator, path_m, strength)
    later[:, 250] += strength  # an echo far from the direct return, which wins where it is strong
    found = np.array([searched(*one) for one in zip(direct, path_m, later, strict=True)])
    at_m, height = waveform.received(direct, path_m, later, BIN_M, SIGMA_M)
    assert np.allclose(at_m, found[:, 0], atol=2e-5 * min(strength, 1.0) + 1e-8)
    assert np.allclose(height, found[:, 1], rtol=1e-5)
    assert ((at_m > 2.0) == (strength > 1.0)).all()


def test_a_lone_echo_is_found_where_it_is(waveform: ModuleType) -> None:
    path_m = np.linspace(0.3, 1.3, 37)
    at_m, height = waveform.received(np.full(37, 2.0), path_m, np.zeros((37, 5)), BIN_M, SIGMA_M)
    assert np.allclose(at_m, path_m, atol=1e-12)
    assert np.allclose(height, 2.0)


@pytest.mark.parametrize("pulse_ns", [0.0, 1.0])
def test_nothing_hidden_is_no_signal(scenes: ModuleType, pulse_ns: float) -> None:
    signal = scenes.Bench(scenes.paper_rig(1e-4), "lambertian", pulse_ns).signal(np.zeros((5120, 3), np.float32))
    assert np.abs(signal.depth_m).max() < 1e-12
    assert np.abs(signal.counts).max() < 1e-9
    assert not signal.lit.any()
    assert signal.direct_wins.all()


@pytest.mark.parametrize(("radiometry", "receiver_cell_m2"), [("paper", 5e-3), ("lambertian", 1e-4)])
def test_the_expected_maps_are_the_renderers_but_for_its_bins(
    scenes: ModuleType, radiometry: str, receiver_cell_m2: float
) -> None:
    rig = scenes.paper_rig(receiver_cell_m2)
    bench, empty = scenes.Bench(rig, radiometry, 1.0), Scene(rig, radiometry=radiometry, pulse_ns=1.0)
    path_m, light = bench.echoes(next(scenes.later_light(rig, radiometry, [2])))
    hidden = replace(empty, object_depth_m=object_depth(scenes.FIRST_SEED + 2, empty.box)[1])
    bare, rendered = render(empty), render(hidden)
    on = bench.on_wall
    rise = rendered.intensity.ravel()[on] / bare.intensity.ravel()[on] - 1
    assert np.abs(path_m - rendered.multi.path_m.ravel()[on]).max() < BIN_M
    assert np.abs(light / bench.echoes(None)[1] - 1 - rise).max() < 0.15 * rise.max()


def test_without_noise_the_chain_gives_the_expected_difference(scenes: ModuleType, noise: ModuleType) -> None:
    bench = scenes.Bench(scenes.paper_rig(5e-3), "paper", 1.0)
    later = next(scenes.later_light(bench.rig, "paper", [5]))
    quiet = noise.SensorModel(range_noise_m=0, range_noise_per_m=0, read_noise_counts=0, shot_noise=0, dead_share=0)
    sensor = noise.Sensor(bench.rig, quiet)
    with_m, without_m = (noise.maps_of(sensor, bench.multi(light), [0])[0][0] for light in (later, None))
    signal, cells = bench.signal(later), noise.wall_cells(bench.rig)
    off_m = np.abs(with_m - without_m - signal.depth_m)[cells & signal.direct_wins]
    assert off_m.max() < 0.0004  # steps of 0.25 mm
    assert np.abs(signal.depth_m[cells & signal.direct_wins]).max() > 0.002


def test_noise_falls_as_the_root_of_the_frames_and_does_not_know_of_a_pattern(noise: ModuleType) -> None:
    generator = np.random.default_rng(2)
    frames = 5.0 + generator.normal(0.0, 0.1, (600, 64, 80)) + generator.normal(0.0, 3.0, (64, 80))
    found = noise.noise_of(frames, frames)
    assert np.allclose(found.depth_m, 0.1, rtol=0.15)
    assert [row["frames"] for row in found.falls] == [1, 3, 10, 30, 100]
    assert all(row["depth_over_law"] == pytest.approx(1.0, abs=0.02) for row in found.falls)
    stuck = np.repeat(frames[::10], 10, axis=0)
    assert noise.noise_of(stuck, stuck).falls[2]["depth_over_law"] > 2.5


def test_drift_grows_with_temperature_from_none_at_the_reference(scenes: ModuleType, noise: ModuleType) -> None:
    rig = scenes.paper_rig(1e-4)
    pattern = noise.Pattern(rig, noise.biased(0.001, 0.0045))
    assert not pattern.drift_m(noise.REFERENCE_CELSIUS).any()
    two, four = (pattern.drift_m(noise.REFERENCE_CELSIUS + warmer) for warmer in (2.0, 4.0))
    assert np.allclose(four, 2 * two, atol=1e-8)
    assert np.mean(two) == pytest.approx(2 * 0.0001, rel=0.05)
    cells = noise.wall_cells(rig)
    unbiased_m, verdict = noise.Pattern(rig, noise.SensorModel()).misfit_m(noise.REFERENCE_CELSIUS)
    assert (verdict, noise.rms(unbiased_m[cells]) < 1e-6) == ("good", True)
    assert noise.rms(pattern.misfit_m(noise.REFERENCE_CELSIUS)[0][cells]) > 0.0005


def test_means_of_cells_are_those_of_their_pixels(noise: ModuleType) -> None:
    image = np.add.outer(np.arange(480.0), 1000 * np.arange(640.0))
    means = noise.cell_means(image)
    assert means.shape == (64, 80)
    assert np.allclose(np.diff(means, axis=1), 8000.0)
    assert np.allclose(means[:, 0] - 3500.0, 7.5 * (np.arange(64) + 0.5) - 0.5, atol=0.5)


def test_averaging_helps_until_the_pattern_is_left(snr: ModuleType) -> None:
    generator = np.random.default_rng(3)
    signal, pattern = generator.normal(0, 1.0, 400), generator.normal(0, 0.5, 400)
    free = snr.Cells(signal, np.full(400, 2.0), np.zeros(400))
    bound = replace(free, pattern=pattern)
    assert snr.ratio(free, 100).rms == pytest.approx(10 * snr.ratio(free, 1).rms)
    assert snr.ratio(free, 25).matched == pytest.approx(5 * np.sqrt(np.sum((signal / 2.0) ** 2)))
    assert snr.ratio(bound, 1e12).rms == pytest.approx(np.sqrt(np.mean(signal**2) / np.mean(pattern**2)))
    assert snr.ratio(bound, 1e12).matched == pytest.approx(np.sum(signal**2) / abs(np.sum(signal * pattern)))
    assert snr.ratio(replace(free, signal=np.zeros(400)), 1e12) == snr.Ratio(0.0, 0.0, 0.0, 0.0, 0.0)
    assert snr.effective(30, 30) == 15
    assert snr.effective(30) == 30


def test_so_many_frames_bring_signal_to_noise_to_one(snr: ModuleType) -> None:
    cells = snr.Cells(np.array([1.0, 0.1, 0.0]), np.full(3, 2.0), np.full(3, 0.2))
    first, second, third = snr.frames_for_cells(cells)
    assert first == pytest.approx(4 / (1 - 0.04))
    assert second == third == np.inf
    frames = snr.frames_for_filter(cells, 3.0)
    assert snr.ratio(cells, frames).matched == pytest.approx(3.0, rel=1e-2)
    assert snr.frames_for_filter(cells, 50.0) == np.inf
    assert snr.hours(108_000) == 1


def test_a_small_study_is_worked_out_told_and_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    study, papers = importlib.import_module("difference_study"), importlib.import_module("difference_paper")
    (tmp_path / "images").mkdir()
    monkeypatch.setattr(study, "DOCS", tmp_path)
    monkeypatch.setattr(study, "USUAL_NOISE_FRAMES", 20)
    monkeypatch.setattr(papers, "RECEIVER_CELLS_M2", (1e-4, 5e-3))
    monkeypatch.setattr(papers, "RIPPLES_M", (0.001,))
    monkeypatch.setattr(papers, "OFFSETS_M", (0.0045,))
    monkeypatch.setattr(sys, "argv", ["difference_study.py", "--objects", "1"])
    study.main()
    told = json.loads((tmp_path / "difference_study.json").read_text(encoding="utf-8"))
    few, most = (row["direct_wins_1_ns"] for row in told["winners"])
    assert few < most
    assert told["chain"][0]["depth_over_law"] == pytest.approx(1.0, abs=0.15)
    usual = told["paper"][1]["merged"]["by_frames"][-1]
    assert usual["raw"]["rms"] < usual["difference"]["rms"]
    assert told["lambertian"]["without_pulse"]["depth_um_max"] == 0
    assert (tmp_path / "images" / "difference_study.png").stat().st_size > 10_000
    tables = [part.splitlines() for part in capsys.readouterr().out.split("\n\n") if part.startswith("|")]
    assert all(len({line.count("|") for line in lines}) == 1 for lines in tables)
    assert tables[-1][2].startswith("| endless reference |")

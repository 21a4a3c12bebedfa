"""The rig as a problem of the gap workflow: made-up benches with a known truth, and the real recordings."""

from pathlib import Path

import numpy as np
import pytest
from rig_bench import Bench, write
from rig_fits import best_fit, nominal, position_errors

from wlr_gym.base.errors import InputError
from wlr_gym.gap.estimation.fit import fit
from wlr_gym.gap.estimation.model import nominal_model
from wlr_gym.gap.problem import Setting
from wlr_gym.gap.rig.pendulum import ENCODER_NOISE, JOINT, RIG_EFFECTS, PendulumProblem
from wlr_gym.gap.rig.pendulum_recordings import read_recordings
from wlr_gym.gap.rig.problem import LOST, law_candidates
from wlr_gym.gap.selection.search import search_effects
from wlr_gym.gap.validation.data_split import named_split
from wlr_gym.physics.effects import PatchEffect

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "xl330_pendulum"
LOADED = Bench(load_ratio=0.15)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    return PendulumProblem(read_recordings(write(tmp_path_factory.mktemp("loaded"), LOADED, gains=(100, 300, 800))))


def split(problem):
    return named_split(problem.runs, problem.held_out)


def true_quantities(problem, bench):
    values = dict(zip([q.name for q in problem.quantities], nominal(problem), strict=True))
    link = 0.49 * 0.1**2
    values |= {
        "stall_torque": 5.0 * bench.torque_constant / bench.resistance,
        "no_load_speed": 5.0 / bench.torque_constant,
        "armature": bench.inertia - link,
        "length_error": bench.gravity / (9.81 * 0.49) - 0.1,
        "arm_mass": 0.0,
        "delay": bench.delay,
        "coulomb_friction": bench.coulomb,
        "viscous_friction": bench.viscous,
    }
    values["armature"] -= 0.49 * ((0.1 + values["length_error"]) ** 2 - 0.1**2)
    return np.array(list(values.values()))


def test_the_true_model_replays_an_independent_bench_to_its_noise(loaded):
    truth = Setting(
        true_quantities(loaded, LOADED), (PatchEffect("load_dependent_friction", ("servo",), {"ratio": LOADED.load_ratio}),)
    )
    runs = range(len(loaded.runs))
    errors = position_errors(loaded, truth, runs)
    assert np.median(errors) < 1e-3
    assert errors.max() < 6e-3  # the bench's friction, smooth at rest, creeps while it holds a load
    assert position_errors(loaded, Setting(truth.quantities), runs).min() > 10e-3
    shortly = np.concatenate([r[0, :, 1] for r in loaded.residuals([truth], runs)])
    assert np.sqrt(np.mean(shortly**2)) < 4.0


def test_residuals_are_in_counts_of_the_encoder_and_by_run(loaded):
    setting = Setting(nominal(loaded))
    (one,) = loaded.residuals([setting, setting], [2])
    rows = len(loaded.times(2))
    assert one.shape == (2, rows, 2)
    assert (one[0] == one[1]).all()
    (angles,) = loaded.simulate([setting], [2])
    np.testing.assert_allclose(one[0] * ENCODER_NOISE, loaded.measured(2) - angles[0], atol=1e-12)
    assert np.abs(one[0, :3]).max() < 3.0  # starts where the measurement does
    whole, within = (np.concatenate([r[0, :, k] for r in loaded.residuals([setting], range(9))]) for k in (0, 1))
    assert np.std(within) < 0.8 * np.std(whole)  # short windows forget, the whole run drifts off


def test_encoder_zero_moves_gravity_and_not_the_start(loaded):
    values = nominal(loaded)
    shifted = values.copy()
    shifted[[q.name for q in loaded.quantities].index("zero")] = 0.1
    plain, moved = loaded.simulate([Setting(values), Setting(shifted)], [0])[0]
    assert abs(moved[0, 0] - plain[0, 0]) < 1e-12
    assert np.abs(moved - plain).max() > 0.01


def test_every_effect_is_neutral_where_it_says_and_acts_elsewhere(loaded):
    values = nominal(loaded)
    strongest = 6
    (plain,) = loaded.simulate([Setting(values)], [strongest])
    for name, effect in RIG_EFFECTS.items():
        neutral = {key: float(p.neutral) for key, p in effect.parameters.items()}
        severe = {key: p.severity for key, p in effect.parameters.items()} | ({"torque": 0.2} if name == "torque_limit" else {})
        settings = [Setting(values, (PatchEffect(name, ("servo",), numbers),)) for numbers in (neutral, severe)]
        (found,) = loaded.simulate(settings, [strongest])
        assert (found[0] == plain[0]).all(), name
        assert np.abs(found[1] - plain[0]).max() > 1e-3, name


def test_every_probe_is_felt_and_candidates_start_from_them(loaded):
    probes, _ = law_candidates(RIG_EFFECTS, JOINT, {"load_dependent_friction", "coulomb_friction"})
    probes = [probe for probe in probes if not probe.key.startswith("torque_limit")]  # this bench does not reach them
    settings = [Setting(nominal(loaded), probe.effects) for probe in probes]
    base, *found = (r for r in loaded.residuals([Setting(nominal(loaded)), *settings], [6])[0])
    for probe, residual in zip(probes, found, strict=True):
        assert np.abs(residual - base).max() > 0.1, probe.key
    probes, candidates = law_candidates(RIG_EFFECTS, JOINT, set())
    keys = {probe.key for probe in probes}
    for candidate in candidates:
        for start in candidate.starts:
            assert {key for direction in start.directions for key in direction} <= keys
            assert len(start.values(np.ones(len(start.directions)))) == len(candidate.unknowns)


def test_candidates_leave_out_what_is_there_and_keep_the_order_of_a_series(loaded):
    def names(*present):
        effects = tuple(PatchEffect(n, ("servo",), {"ratio": 0.1}) for n in present)
        return {c.name for c in loaded.candidates(Setting(nominal(loaded), effects), [], [])[1]}

    assert "load_dependent_friction" in names()
    assert not names() & {"coulomb_friction", "viscous_friction", "quadratic_load_friction"}
    with_load = names("load_dependent_friction")
    assert "load_dependent_friction" not in with_load
    assert "quadratic_load_friction" in with_load


def test_features_name_what_residuals_are_mapped_over(loaded):
    (features,) = loaded.features(Setting(nominal(loaded)), [3])
    rows = len(loaded.times(3))
    assert all(values.shape == (rows,) and np.isfinite(values).all() for values in features.values())
    assert features["time since reversal [s]"].min() == 0.0
    assert np.abs(features["motor torque [N m]"]).max() > 0.05


def test_unknown_effects_and_missing_parameters_are_refused(loaded):
    for effect, message in (
        (PatchEffect("rolling_resistance", ("servo",), {"coefficient": 0.1}), "unknown effect of the test rig"),
        (PatchEffect("backlash", ("servo",), {}), "backlash: has no 'angle'"),
    ):
        with pytest.raises(InputError, match=message):
            loaded.residuals([Setting(nominal(loaded), (effect,))], [0])
    with pytest.raises(InputError, match="no recordings"):
        PendulumProblem([])


def test_a_formula_acts_like_the_effect_it_spells_out(loaded):
    """Viscous friction and a spring against gravity, as formulas and as numbers of the model."""
    values = nominal(loaded)
    more = values.copy()
    more[[q.name for q in loaded.quantities].index("viscous_friction")] += 0.004
    formula = PatchEffect("unknown_effect", ("servo",), {"b": 0.004}, "-b * rate", {"b": "N m s/rad"})
    none = PatchEffect("unknown_effect", ("servo",), {"b": 0.0}, "-b * rate", {"b": "N m s/rad"})
    (found,) = loaded.simulate([Setting(values), Setting(more), Setting(values, (formula,)), Setting(values, (none,))], [4])
    assert np.abs(found[2] - found[1]).max() < 0.05 * np.abs(found[1] - found[0]).max()
    np.testing.assert_allclose(found[3], found[0], atol=1e-9)


def test_a_simulation_that_breaks_down_is_as_far_off_as_can_be(loaded):
    """A servo that feeds itself speed: neither is that nothing, nor are its rows before the end anything."""
    setting = Setting(nominal(loaded))
    running_away = PatchEffect("unknown_effect", ("servo",), {"b": 5.0}, "b * rate", {"b": "N m s/rad"})
    (simulated,) = loaded.simulate([Setting(setting.quantities, (running_away,))], [4])
    assert not np.isfinite(simulated).all()
    (plain,), (both,) = (
        loaded.residuals(settings, [4]) for settings in ([setting], [setting, Setting(setting.quantities, (running_away,))])
    )
    assert (both[0] == plain[0]).all()
    assert (both[1] == LOST).all()
    assert np.abs(both[0]).max() < LOST


def test_where_a_formula_was_tried(loaded):
    setting = Setting(nominal(loaded))
    formula = PatchEffect("unknown_effect", ("servo",), {"b": 0.004}, "-b * rate * abs(angle)", {"b": "N m s/rad2"})
    found = loaded.reach(formula, setting, [0, 1])
    assert {name: one.unit for name, one in found.items()} == {"rate": "rad/s", "angle": "rad"}
    replayed = loaded.simulate([setting], [0, 1])
    angles = np.concatenate([values[0][:, [s.name for s in loaded.signals].index("position")] for values in replayed])
    assert (found["angle"].low, found["angle"].high) == pytest.approx((np.nanmin(angles), np.nanmax(angles)), abs=0.05)


@pytest.mark.parametrize(
    ("formula", "message"),
    [("-b * rate * rate", "takes N m"), ("-b * normal_force", "reads angle, rate"), ("-b * (rate", "formula")],
)
def test_broken_formulas_are_refused(loaded, formula, message):
    effect = PatchEffect("unknown_effect", ("servo",), {"b": 0.004}, formula, {"b": "N m s/rad" if "rate" in formula else "m"})
    with pytest.raises(InputError, match=message):
        loaded.residuals([Setting(nominal(loaded), (effect,))], [0])


# --- the workflow on it


def named(problem, runs):
    """Name effects by the quick way: these benches answer smoothly."""
    problem.thorough = False
    return search_effects(problem, runs, fit(problem, runs, nominal_model(problem), steps=12))


def test_hidden_load_dependent_friction_is_named_and_measured(loaded):
    fitted, held = split(loaded)
    found = named(loaded, fitted).fit.model
    assert [candidate.name for candidate, _ in found.effects] == ["load_dependent_friction"]
    assert found.effects[0][1][0] == pytest.approx(LOADED.load_ratio, rel=0.1)
    without = fit(loaded, fitted, nominal_model(loaded), steps=12).model
    after, before = (position_errors(loaded, m.setting, held).mean() for m in (found, without))
    assert after < 0.3 * before


def test_other_numbers_alone_are_no_effect(tmp_path):
    bench = Bench(torque_constant=0.5, resistance=4.8, coulomb=0.04, viscous=0.008, inertia=0.0068, gravity=0.5)
    problem = PendulumProblem(read_recordings(write(tmp_path, bench, gains=(100, 400))))
    assert named(problem, range(len(problem.runs))).fit.model.effects == ()


def test_a_model_without_friction_is_told_that_it_lacks_friction(tmp_path):
    problem = PendulumProblem(read_recordings(write(tmp_path, Bench(), gains=(100, 400))), friction_is_known=False)
    assert not any("friction" in quantity.name for quantity in problem.quantities)
    assert "coulomb_friction" in {candidate.name for candidate, _ in named(problem, range(6)).fit.model.effects}


# --- the real servo


@pytest.fixture(scope="module")
def real():
    return PendulumProblem(read_recordings(REAL))


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the repository")
def test_real_servo_lacks_load_dependent_friction_and_a_torque_that_falls_behind(real):
    """Against the Coulomb-viscous base; runs held out as the workflow would."""
    fitted, held = split(real)
    load, behind = {"load_dependent_friction": (0.2,)}, {"torque_saturation": (0.4,)}
    both = best_fit(real, fitted, load | behind)
    autocorrelation_time = both.noise.autocorrelation_time
    base, only_load, only_behind, stribeck, with_stribeck, warm = (
        best_fit(real, fitted, effects, autocorrelation_time)
        for effects in (
            {},
            load,
            behind,
            {"stribeck_friction": (0.03, 0.1)},
            load | behind | {"stribeck_friction": (0.03, 0.1)},
            load | {"warm_winding": (0.004,)},
        )
    )
    assert both.cost < min(only_load.cost, only_behind.cost) - 60
    gain = {
        name: base.cost - found.cost for name, found in (("load", only_load), ("behind", only_behind), ("stribeck", stribeck))
    }
    assert gain["stribeck"] < 0.3 * min(gain["load"], gain["behind"])  # alone it takes the place of what is missing
    assert with_stribeck.cost > both.cost - 60
    assert warm.cost > both.cost + 60
    assert warm.model.effects[-1][1][0] == pytest.approx(0.0045)  # at the edge of what a winding can do

    def heldout(found):
        return 1e3 * position_errors(real, found.model.setting, held).mean()

    assert 45 < heldout(base) < 75
    assert heldout(both) < 0.6 * heldout(base)
    assert heldout(with_stribeck) > 0.9 * heldout(both)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the repository")
def test_real_servo_replays_better_with_both(real):
    """The quick form: numbers found by the slow one, replayed on every run."""
    names = [quantity.name for quantity in real.quantities]
    base, both = nominal(real).copy(), nominal(real).copy()
    for values, numbers in ((base, BASE), (both, BOTH)):
        for name, value in numbers.items():
            values[names.index(name)] = value
    effects = (
        PatchEffect("load_dependent_friction", ("servo",), {"ratio": 0.25}),
        PatchEffect("torque_saturation", ("servo",), {"coefficient": 0.32}),
    )
    runs = range(len(real.runs))
    before = 1e3 * position_errors(real, Setting(base), runs).mean()
    after = 1e3 * position_errors(real, Setting(both, effects), runs).mean()
    assert 55 < before < 75
    assert after < 0.5 * before


BASE = {
    "stall_torque": 0.36,
    "no_load_speed": 11.0,
    "armature": 0.0016,
    "delay": 0.0,
    "zero": -0.018,
    "coulomb_friction": 0.041,
    "viscous_friction": 0.0,
}
BOTH = {
    "stall_torque": 0.77,
    "no_load_speed": 13.9,
    "armature": 0.0018,
    "delay": 0.006,
    "zero": -0.02,
    "coulomb_friction": 0.021,
    "viscous_friction": 0.006,
}

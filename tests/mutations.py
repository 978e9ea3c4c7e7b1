"""Faults on purpose: does the suite notice a wrong formula? Not a test; run it by hand.

    python tests/mutations.py [NAME ...] [--list] [--slow]

Each row of ROWS is one small fault in the package: its name, the file, a text that the file holds
once, what stands there instead, and the tests that a developer would expect to notice. The tree is
copied to a temporary folder. All these tests must pass there first. Then each fault is made alone,
its tests are run, and it is taken back: `caught` if a test fails, `survived` if all pass. NAME:
these rows only, all without one. `--list`: no test is run, the rows are held against the sources.
Long tests count, `--slow`: slow ones, too. Results go to tests/bench/results/mutations.jsonl, the
last line of a name is the one that counts. The exit code is 1 where a fault survived. All rows take
some 20 minutes of one core.
"""

import argparse
import functools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "tests/bench/results/mutations.jsonl"

#: By group: name, file of the package, old text, new text, tests with a space between them.
ROWS = {
    "mechanics": [
        ("law-tangent", "mechanics/force_law.py",
         "*(power(name) * k for name, k in rest)], depth * depth)",
         "*(k for name, k in rest)], depth * depth)", "test_residual.py"),
        ("fold-depth", "mechanics/force_law.py",
         "jnp.where(softening, -3 * law.k_3, 1)", "jnp.where(softening, -2 * law.k_3, 1)",
         "test_force_law.py::test_fold_is_where_the_law_peaks"),
        ("blend-shares", "mechanics/force_law.py",
         "share = ring.k_1 / softer, ligament.k_1 / softer",
         "share = ligament.k_1 / softer, ring.k_1 / softer",
         "test_force_law.py::test_blend_is_springs_in_series"),
        ("shear-determinant", "mechanics/compliance.py",
         "det = det + (h / GA) * (c + f)", "det = det + (h / GA) * c",
         "test_beam.py::test_reactions_same_answer test_beam.py::test_limits_in_closed_form"),
        ("paper-shares", "mechanics/compliance.py",
         "cubes = (s / jnp.sum(s)) ** 3", "cubes = (s / jnp.sum(s)) ** 2",
         "test_beam.py::test_independent_against_fem"),
        ("spatial-span", "mechanics/spatial_beam.py",
         "slide = hinge * (h * h / 12)", "slide = hinge * (h * h / 6)", "test_spatial_beam.py"),
        ("axial-ring", "mechanics/axial.py",
         "upto_ring = jnp.cumsum((high - low) / EA)[:-1]",
         "upto_ring = jnp.cumsum((high - low) / EA)[1:]", "test_axial.py::test_against_bar_fem"),
        ("tie-of-the-mat", "mechanics/ring.py",
         "k_e = ring.k_t + ring.k_M / 4", "k_e = ring.k_t + ring.k_M / 2",
         "test_ring.py::test_shape_and_ends_against_frame"),
        ("punch-edges", "mechanics/punch.py",
         "first, second = c_22 - c_12, c_11 - c_12", "first, second = c_11 - c_12, c_22 - c_12",
         "test_punch.py::test_against_finite_elements"),
        ("softening-peak", "mechanics/softening.py",
         "-2 * e_1, 3 * e_2)", "-2 * e_1, 2 * e_2)",
         "test_softening.py::test_the_peak_is_where_the_law_turns"),
        ("friction-cone", "mechanics/friction.py",
         "lean = jnp.sqrt(1 + mu * mu)", "lean = 1 + mu * mu", "test_friction.py"),
        ("axial-sides", "mechanics/skeleton.py",
         "passed = jnp.where(x <= s_c, along.force_A, along.force_B)",
         "passed = jnp.where(x <= s_c, along.force_B, along.force_A)",
         "test_oblique.py::test_axial_share_is_equal_along_each_side"),
        ("section-bending", "mechanics/sections/contact.py",
         "return beam.warps / (1 + 12 * beam.bending", "return beam.warps / (1 + 6 * beam.bending",
         "sections/test_parts.py::test_the_place_of_a_contact"),
        ("wall-slides", "mechanics/sections/material.py",
         "(4 * wall.E_L * tool_radius)", "(8 * wall.E_L * tool_radius)",
         "sections/test_specimen.py::test_a_tool_slides_as_cerruti_s_half_space"),
        ("fit-compliance", "mechanics/equilibrium.py",
         '"compliance": -slope * force * share}', '"compliance": -slope * force}',
         "test_residual.py"),
    ],
    "fitting and inference": [
        ("aicc", "fitting/criteria.py",
         "2 * k * (k + 1) / left", "2 * k * k / left",
         "test_criteria.py::test_linear_case_in_closed_form"),
        ("noise-freedom", "fitting/noise.py",
         "np.maximum(1 - own / np.maximum(total, 1), 0.05)",
         "np.maximum(1 - 1 / np.maximum(total, 1), 0.05)",
         "test_covariance.py::test_estimated_noise_is_over_what_the_unknowns_leave"),
        ("robust-sigma", "fitting/noise.py",
         "estimate = 1.4826 * info.spread", "estimate = 1.2533 * info.spread",
         "test_closed_forms.py::test_noise_of_a_robust_fit_is_the_median_of_a_normal_distribution"),
        ("student-t", "fitting/covariance.py",
         "of_t = stdtrit(different, 0.975)", "of_t = stdtrit(different, 0.95)",
         "test_covariance.py::test_intervals_are_those_of_the_tables"),
        ("robust-kappa", "fitting/covariance.py",
         "/ _mean_slope(info) ** 2", "/ _mean_slope(info)",
         "test_covariance.py::test_covariance_of_a_robust_fit"),
        ("misfit-chance", "fitting/misfit.py",
         "statistic = ratio**2 * left", "statistic = ratio * left",
         "test_misfit.py::test_eleven_samples_are_told_by_chi_squared"),
        ("alike-residuals", "fitting/effective.py",
         "return (1 - r) / (1 + r)", "return (1 - r) / (1 + r * r)",
         "test_reports.py::test_independent_residuals_widen_nothing"),
        ("curve-weights", "fitting/curve_noise.py",
         "for v in (count * sigma**2, count))", "for v in (count * sigma, count))",
         "test_record_faults.py::test_uneven_noise_and_its_weights"),
        ("share-likelihood", "fitting/force_share.py",
         "cost = len(r) * np.log(squared)", "cost = 0.5 * len(r) * np.log(squared)",
         "test_force_share.py::test_sigma_and_share_are_found"),
        ("restricted-likelihood", "inference/random_effects.py",
         '- 0.5 * np.einsum("mjj->j", inner)', '- 0.5 * np.einsum("mjj->j", W)',
         "test_population.py::test_balanced_one_way_layout"),
        ("profile-ends", "inference/profile.py",
         "(best - reach[:, 0], best + reach[:, 1])",
         "(best - reach[:, 1], best + reach[:, 0])",
         "test_profile.py::test_an_estimate_on_its_bound_has_the_other_side"),
        ("posterior-volume", "inference/posterior.py",
         " - jnp.sum(counts * log_noise)", "",
         "test_posterior.py::test_density_is_that_of_the_normal_noise"),
        ("leverage", "inference/influence.py",
         "left = 1 - 2 * leverage +", "left = 1 - leverage +",
         "test_influence.py::test_one_unknown_is_the_textbook"),
        ("bootstrap-freedom", "inference/bootstrap.py",
         "enlarge = np.sqrt(total / max(total - unknowns, 1))",
         "enlarge = np.sqrt(total / max(total, 1))",
         "test_closed_forms.py::test_resampled_residuals_have_the_variance_of_the_noise"),
        ("left-out-ratio", "inference/cross_validation.py",
         "/ np.sum(model * model, axis=1) - 1", "/ np.sum(data * data, axis=1) - 1",
         "test_criteria.py::test_ratio_of_a_curve_left_out_is_that_of_least_squares"),
    ],
    "scene and contact": [
        ("radius-of-b", "contact/distance.py",
         "_minimum(pair, n) - (a.radius + b.radius)", "_minimum(pair, n) - 2 * a.radius",
         "test_distance.py::test_witness_points"),
        ("lower-bound", "contact/distance.py",
         "sharp_support(b, -n)), upper", "sharp_support(b, n)), upper",
         "test_distance.py::test_witness_points"),
        ("inverse-pose", "contact/pose.py",
         "Pose(back, -rotate(back,", "Pose(back, rotate(back,",
         "test_contact_shapes.py::test_poses_form_a_group"),
        ("small-turns", "contact/pose.py",
         "0.5 - square / 24 *", "0.5 - square / 12 *",
         "test_contact_shapes.py::test_rotation_derivatives_are_finite_and_right"),
        ("beyond-the-line", "contact/line.py",
         "return c + beyond * t, t,", "return c, t,",
         "test_patches.py::test_skeleton_coordinates_on_an_arc "
         "test_patches.py::test_beyond_its_ends_a_line_goes_on_straight"),
        ("gap-of-patches", "contact/patches.py",
         "gap = low - jnp.log(whole) / beta", "gap = low + jnp.log(whole) / beta",
         "test_patches.py::test_continuous_across_borders"),
        ("core-of-a-patch", "contact/walls.py",
         "axis=0) + [0, 0, 0, r], caps", "axis=0) + [0, 0, 0, r / 2], caps",
         "test_patches.py::test_a_steep_funnel_has_a_bounded_patch scene/test_wall_check.py"),
        ("landing-gap", "scene/landing.py",
         "moved = share * chord - gap * inward", "moved = share * chord",
         "scene/test_session.py::test_a_jump_grasps_anew "
         "scene/test_session.py::test_a_seat_follows_the_tool"),
        ("seat-apart", "scene/anchor.py",
         "limit(MAX_MISMATCH * depth, jnp.abs(off[0]))", "limit(MAX_MISMATCH * depth, off[0])",
         "scene/test_session.py::test_what_gives_way_only_loses_energy"),
        ("moment-of-a-pose", "scene/configurational.py",
         "jnp.cross(path.rotation, by.rotation, axis=1)",
         "jnp.cross(by.rotation, path.rotation, axis=1)",
         "scene/test_configurational.py::test_the_moment_is_the_work_of_small_turns"),
        ("wall-of-the-lumen", "scene/lumen.py",
         "wall = 2 * jnp.maximum(", "wall = jnp.maximum(",
         "scene/test_ranges.py::test_a_tool_in_the_lumen_has_no_force "
         "scene/test_ranges.py::test_a_tool_keeps_its_side_of_the_wall"),
        ("slip-round-the-tube", "scene/trail.py",
         "phi_c + around / radius", "phi_c + around",
         "scene/test_trail.py::test_the_place_under_a_slip"),
        ("last-step-of-a-press", "scene/paths.py",
         "whole * (k + 1) / steps", "whole * k / steps",
         "test_configs.py::test_a_press_goes_in_equal_steps_to_its_end"),
        ("sag-of-a-dent", "surface/local.py",
         "jnp.maximum(1 - sag / depth, 0)", "jnp.maximum(1 - sag / (2 * depth), 0)",
         "test_surface.py::test_sag_makes_the_footprint_shallower"),
        ("angle-of-the-rings", "trachea/rings.py",
         "return float(right + left) * math.pi / RAYS",
         "return float(right + left) * 2 * math.pi / RAYS",
         "test_mesh.py::test_rings_from_their_own_surface"),
    ],
    "measurements and prediction": [
        ("unit-of-pressure", "units.py", '"98.0665"', '"9.80665"', "test_units.py::test_factor"),
        ("unit-of-mass", "units.py",
         '"g", Fraction(1, 10**6)', '"g", Fraction(1, 10**3)', "test_units.py::test_factor"),
        ("touch-noise", "measurements/first_touch.py",
         "out[c] = 1.4826 * np.median", "out[c] = np.median",
         "test_onset.py::test_noise_is_told_from_the_shape"),
        ("blend-width", "measurements/first_touch.py",
         "np.minimum(_STANDARD_DEVIATIONS * level / touch.slope,",
         "np.maximum(_STANDARD_DEVIATIONS * level / touch.slope,", "test_onset.py"),
        ("line-in-air", "measurements/record_zeros.py",
         "mean - slope * middle, rise", "mean + slope * middle, rise",
         "test_record_zeros.py::test_a_line_is_told_by_its_force_at_no_displacement"),
        ("last-loading", "measurements/segments.py",
         "full[0] if first else full[-1]", "full[0]", "test_segments.py::test_known_records"),
        ("return-of-a-loading", "measurements/turning.py",
         "_RETURN * (values[top] - values[start])", "_RETURN * (values[peak] - values[start])",
         "test_segments.py::test_loadings_of_the_records test_segments.py::test_known_records"),
        ("softer-cycle", "measurements/returns.py",
         "(heights[1] - heights[0]) / rise", "(heights[0] - heights[1]) / rise",
         "test_record_faults.py::test_faults_are_said"),
        ("rig-compliance", "measurements/machine.py",
         "return displacement - compliance * force", "return displacement + compliance * force",
         "test_record_faults.py::test_machine_compliance"),
        ("end-of-a-range", "measurements/presses.py",
         "step * np.arange(whole + 1)", "step * np.arange(whole)",
         "prediction/test_predict_command.py::test_a_range_ends_within_its_end"),
        ("sign-of-side-force", "measurements/vectors.py",
         "options.force_sign if q.turns else 1", "1",
         "test_measured_vectors.py::test_signs"),
        ("left-out-step", "prediction/model_error.py",
         "step = half @ (half.T @", "step = -half @ (half.T @",
         "prediction/test_model_error.py::test_leaving_out_is_refitting"),
        ("own-follows-kept", "prediction/held_out.py",
         "= -inverse @ (A.T @ B)", "= inverse @ (A.T @ B)",
         "test_own_touch.py::test_own_parameters_follow_those_that_are_kept"),
        ("widened-bands", "prediction/curves.py",
         "source.covariance * error.growth**2", "source.covariance * error.growth",
         "prediction/test_bands.py::test_standard_errors_are_those_of_the_delta_method "
         "prediction/test_model_error.py::test_standard_errors_grow_as_intervals_do"),
        ("band-of-a-sample", "prediction/curves.py",
         "self.half_width * np.hypot(self.se, sigma)", "self.half_width * (self.se + sigma)",
         "prediction/test_bands.py::test_standard_errors_are_those_of_the_delta_method "
         "prediction/test_model_error.py::test_a_band_says_what_it_knows"),
    ],
}  # fmt: skip


def copied(folder: Path) -> None:
    """Copy the files that git tracks, and others that it does not ignore."""
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.check_output(words, cwd=ROOT, text=True).split("\0"):
        if name and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


@functools.cache
def flags() -> str:
    """Those of the compiler that tests/conftest.py tries out, in each process of its own."""
    code = "import os, conftest; print(os.environ['XLA_FLAGS'])"
    words = [sys.executable, "-c", code]
    return subprocess.check_output(words, cwd=ROOT / "tests", text=True).strip()


def outcome(folder: Path, tests: list[str], slow: bool) -> str:
    """How the tests end in a copy, which has a tests/conftest.py to set up all else."""
    # No byte code: a fault of equal length within a second would not be seen.
    env = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    env["XLA_FLAGS"] = flags()
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
    words += ["-m", "slow or not slow" if slow else "not slow"]
    words += [f"tests/{name}" for name in dict.fromkeys(tests)]
    done = subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        print(done.stdout[-2000:], done.stderr[-2000:])
    return {0: "survived", 1: "caught"}.get(done.returncode, f"pytest ended {done.returncode}")


def main() -> int:
    """Make the faults asked for and say which were noticed."""
    ask = argparse.ArgumentParser(description="Faults on purpose; see the top of the file.")
    ask.add_argument("names", nargs="*", metavar="NAME")
    ask.add_argument("--list", action="store_true", help="check the rows, run nothing")
    ask.add_argument("--slow", action="store_true", help="slow tests, too")
    given = ask.parse_args()
    rows = [(group, *row) for group, of_group in ROWS.items() for row in of_group]
    if unknown := set(given.names) - {row[1] for row in rows}:
        ask.error(f"no row is named {', '.join(sorted(unknown))}")
    rows = [row for row in rows if not given.names or row[1] in given.names]
    counts = [(ROOT / "jaxtrachea" / file).read_text().count(old) for _, _, file, old, _, _ in rows]
    for (_, name, file, *_), count in zip(rows, counts, strict=True):
        if given.list or count != 1:
            print(f"{name:22} {file}: the old text stands there {count} times")
    if given.list or set(counts) != {1}:
        return int(set(counts) != {1})
    found: dict[str, list[str]] = {group: [] for group in ROWS}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        copied(folder)
        if outcome(folder, " ".join(row[5] for row in rows).split(), given.slow) != "survived":
            print("without a fault not all of these tests pass")
            return 2
        for group, name, file, old, new, tests in rows:
            path, begin = folder / "jaxtrachea" / file, time.perf_counter()
            sound = path.read_text()
            path.write_text(sound.replace(old, new))
            ended = outcome(folder, tests.split(), given.slow)
            path.write_text(sound)
            seconds = round(time.perf_counter() - begin, 1)
            found[group].append(ended)
            print(f"{name:22} {ended:10} {seconds:6} s  {tests}", flush=True)
            row = {"group": group, "name": name, "outcome": ended, "s": seconds, "tests": tests}
            with RESULTS.open("a") as out:
                out.write(json.dumps(row) + "\n")
    for group, ends in found.items():
        print(f"{group:30} {ends.count('caught'):3} of {len(ends)} caught")
    return int(any(end != "caught" for ends in found.values() for end in ends))


if __name__ == "__main__":
    sys.exit(main())

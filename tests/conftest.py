"""Strict settings for the whole suite: float64, no silent promotion, shapes checked."""

import functools
import gc
import os
import subprocess
import sys
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Also for the commands that tests start: nothing is written beside the tests.
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"

import jax
import jaxtyping
import pytest


def _compile_quickly() -> None:
    """Compile in a third of the time: no optimisation, one module, XLA's older code generator.

    Most of the suite is compilation of programs that run for milliseconds. A flag that this XLA
    does not know ends its process, so they are tried first. XLA_FLAGS from outside comes first:
    slow tests that are not marked `compiling`, and one run of the default suite, take the optimised
    programs (.ci/run).
    """
    if "XLA_FLAGS" in os.environ:
        return
    plain = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
    start = [sys.executable, "-c", "import jax; jax.devices()"]
    for flags in (f"{plain} --xla_cpu_use_fusion_emitters=false", plain):
        tried = subprocess.run(start, env=os.environ | {"XLA_FLAGS": flags}, capture_output=True)
        if tried.returncode == 0:
            os.environ["XLA_FLAGS"] = flags
            return
    os.environ["XLA_FLAGS"] = ""


_compile_quickly()
# Tracing makes objects by the million that live on: searched for cycles as often as usual, they
# cost a tenth of the suite. What is there before the first test is never searched.
gc.disable()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def _check_what_is_annotated() -> None:
    """Shapes and types of all that is annotated are checked, also in modules imported later.

    The hook decorates every function, one inside of another each time that it is defined: a fifth
    of the time of joint fits. One without annotations has nothing to check.
    """
    decorate = jaxtyping.jaxtyped

    def checked(*given, typechecker):
        if not given:
            return functools.partial(checked, typechecker=typechecker)
        (one,) = given
        told = isinstance(one, type) or getattr(one, "__annotations__", True)
        return decorate(one, typechecker=typechecker) if told else one

    jaxtyping.jaxtyped = checked
    jaxtyping.install_import_hook("jaxtrachea", "beartype.beartype")


_check_what_is_annotated()

pytest_plugins = ["costs"]


#: Programs compiled since they were last dropped.
_compiled = 0


def _count(event, duration, **_):
    global _compiled
    _compiled += event == "/jax/core/compile/backend_compile_duration"


jax.monitoring.register_event_duration_secs_listener(_count)


def _mapped() -> int:
    """Pieces of memory that this process maps; 0 where the system does not tell."""
    try:
        with open("/proc/self/maps", "rb") as pieces:
            return sum(1 for _ in pieces)
    except OSError:
        return 0


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Compiled programs are dropped after some files; all together would take gigabytes.

    Not after every file: a fifth and more of the small ones serve the next file too. A process may
    map 65,530 pieces of memory, and beyond XLA ends it: an optimised program takes some 100 of
    them, that of a press on deforming sections 1,000; the largest files add 10,000.
    """
    global _compiled
    yield
    if _compiled > 400 or _mapped() > 30_000:
        jax.clear_caches()
        gc.collect()
        _compiled = 0


@pytest.fixture
def on_the_cpu():
    """Whatever device JAX names first: for what is made for CPUs alone, single kernels say."""
    with jax.default_device(jax.devices("cpu")[0]):
        yield


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """No slow test begins after `SLOW_TESTS_UNTIL` (seconds since the epoch, set by .ci/run)."""
    until = os.environ.get("SLOW_TESTS_UNTIL")
    if until and time.time() > float(until):
        pytest.skip(f"no time is left for {item.nodeid}")


#: Files that take longest begin, so that none runs on alone at the end; default and long tests.
LONGEST = (
    "test_view.py",
    "test_press_in_time.py",
    "test_relaxing.py",
    "test_contracts.py",
    "test_damaged.py",
    "test_compound.py",
    "test_fits.py",
    "test_parts.py",
    "test_step.py",
    "test_session.py",
    "test_rub.py",
    "test_online.py",
    "test_fit.py",
    "test_mesh.py",
    "test_layering.py",
    "test_contacts.py",
    "test_beam.py",
    "test_study.py",
    "test_cli.py",
    "test_tool_file.py",
    "test_relaxing_fit.py",
    "test_relaxation.py",
    "test_profile.py",
    "test_fit_pictures.py",
    "test_levels.py",
    "test_patches.py",
    "test_oblique.py",
    "test_design.py",
    "test_width.py",
    "test_surface.py",
    "test_in_time.py",
)
#: The same for the slow tests, both halves.
LONGEST_SLOW = (
    "test_configs.py",
    "test_docs.py",
    "test_selfcheck.py",
    "test_contracts.py",
    "test_verify.py",
    "test_fits.py",
    "test_design.py",
    "test_predictions.py",
    "test_relaxing_fits.py",
    "test_section_analyses.py",
    "test_section_residual.py",
    "test_press.py",
    "test_bands.py",
    "test_patches.py",
    "test_sections.py",
    "test_derivatives.py",
    "test_press_derivatives.py",
    "test_tradeoff.py",
    "test_trial_cost.py",
    "test_session.py",
    "test_step.py",
    "test_rub.py",
    "test_simulate.py",
    "test_ranges.py",
    "test_tools.py",
)


def pytest_collection_finish():
    """The modules are read: from here on cycles are searched for, now and then."""
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)
    gc.enable()


def pytest_collection_modifyitems(config, items):
    """Order of the files as CI runs them; --no-loadscope-reorder leaves it so."""
    chosen = config.getoption("markexpr")
    longest = LONGEST_SLOW if chosen.startswith("slow") else LONGEST
    rank = {name: place for place, name in enumerate(longest)}
    items.sort(key=lambda item: rank.get(item.path.name, len(longest)))

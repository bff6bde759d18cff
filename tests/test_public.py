"""What `import jaxdeconf as jd` gives: about twenty names, in two seconds, and nothing heavy."""

import subprocess
import sys

import jaxdeconf as jd

NAMES = {
    *("System", "systems", "Demos", "Config", "run"),
    *("hoeffding_d", "refined_d", "p_value", "threshold", "permutation_p_value"),
    *("dependence", "required_trajectories"),
    *("Mask", "find_mask", "find_region", "Method", "METHODS", "Evidence"),
    *("deconfound", "learn_latents", "mask_latents", "clone_policy"),
    *("drive", "rollout_loss", "copycat", "load_view"),
}


def test_the_names_are_there_and_callable_or_tables():
    for name in NAMES:
        assert getattr(jd, name) is not None
    assert callable(jd.deconfound)  # the function, not the module of its name
    assert jd.find_mask.__module__ == "jaxdeconf.mask"


def test_importing_takes_little_time():
    """Processor time, not the clock: others may use this machine."""
    code = "import time; import jaxdeconf; print(time.process_time())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 4.0  # two seconds, and as much for a slow machine

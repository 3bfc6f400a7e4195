"""Memory of a command while it runs, for tests and benchmarks."""

import subprocess
import time


def peak_private_mb(command):
    """Run a command; the largest RssAnon seen while it ran, in MB."""
    peak = 0
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None:
            try:
                with open(f"/proc/{process.pid}/status") as status:
                    found = [line for line in status if line.startswith("RssAnon")]
            except OSError:
                break
            peak = max([peak, *(int(line.split()[1]) for line in found)])
            time.sleep(0.003)
    assert process.returncode == 0
    return peak / 1024

"""Process that records noise: arguments are PATH, FRAMES and, as if a disk were full, the largest
bytes of a file.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tools" / "robustness"))

from conftest import record_noise

from nlos_cam.errors import DiskFullError

if len(sys.argv) > 3:
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
try:
    record_noise(Path(sys.argv[1]), int(sys.argv[2]))
except DiskFullError as error:
    sys.stdout.write(f"{error}\n")

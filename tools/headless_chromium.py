"""The Chromium that draws the view where there is no screen and no GPU."""

import shutil

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
"""Options by which it draws on the processor."""

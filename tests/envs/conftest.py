"""Puts this directory on the import path, so that the tests here can import their helpers."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

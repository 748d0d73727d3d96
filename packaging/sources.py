"""The sources of a release."""
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
REPOSITORY = re.search(r'^repository = "(.*)"$', (ROOT / "Cargo.toml").read_text(), re.M).group(1)
# Of the program: its sources, the kernel objects, and the libraries of the page. The libraries of
# Rust have their own list.
LICENCE = "(Apache-2.0 OR MIT) AND (GPL-2.0-only OR Apache-2.0) AND Apache-2.0 AND MIT"

"""On PYTHONPATH this hides gtsam from an interpreter and from all that it starts."""

import sys

sys.modules["gtsam"] = None  # type: ignore[assignment]

"""Synthetic surveys with truth, and the oracle backbone."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ..files.owned import OwnedFolder
from ..files.ownership import SURVEY
from ..protocol import Progress, ProgressCallback
from .flight import Survey, SurveyOptions, TrueView, plan_survey
from .photographs import render, write_photograph
from .truth import write_truth

__all__ = ["Survey", "SurveyOptions", "TrueView", "plan_survey", "simulate_survey"]


def simulate_survey(out: Path, options: SurveyOptions, progress: ProgressCallback | None = None) -> Survey:
    """Render a survey into out/photos/*.JPG and write its truth into out/truth/; return the survey.

    The same options give the same survey; an earlier one in `out` is replaced as a whole. Raises `OptionError` for a
    plan that cannot be flown, as `OwnedFolder.claim` does when `out` is not ours, and whatever `progress` raises,
    which ends the rendering early and leaves what was there.
    """
    survey = plan_survey(options)
    with OwnedFolder.claim(Path(out), "simulate") as folder, folder.scratch() as made:
        _render(made, survey, progress)
        folder.publish(made, SURVEY)
    return survey


def _render(out: Path, survey: Survey, progress: ProgressCallback | None) -> None:
    def photograph(view: TrueView) -> None:
        write_photograph(out / "photos" / view.name, render(survey.scene, view), view)

    write_truth(survey, out / "truth")
    count = len(survey.views)
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        try:
            for done, _ in enumerate(pool.map(photograph, survey.views)):
                if progress is not None:
                    progress(Progress("simulate", done, count))
        except BaseException:  # cancelled: what waits is not worth rendering
            pool.shutdown(cancel_futures=True)
            raise
    if progress is not None:
        progress(Progress("simulate", count, count))

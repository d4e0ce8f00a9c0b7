"""Synthetic surveys with truth, and the oracle backbone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..protocol import Progress, ProgressCallback

if TYPE_CHECKING:
    from .flight import Survey, SurveyOptions

__all__ = ["simulate_survey"]


def simulate_survey(out: Path, options: SurveyOptions, progress: ProgressCallback | None = None) -> Survey:
    """Render a survey into out/photos/*.JPG and write its truth into out/truth/; return the survey.

    The same options give the same survey. Raises `OptionError` for a plan that cannot be flown.
    """
    from .flight import plan_survey
    from .photographs import photograph_survey_view
    from .truth import write_truth

    survey = plan_survey(options)
    photos = out / "photos"
    photos.mkdir(parents=True, exist_ok=True)
    write_truth(survey, out / "truth")
    for done, view in enumerate(survey.views):
        if progress is not None:
            progress(Progress("simulate", done, len(survey.views)))
        photograph_survey_view(survey, view, photos)
    if progress is not None:
        progress(Progress("simulate", len(survey.views), len(survey.views)))
    return survey

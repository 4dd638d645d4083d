from .against_truth import evaluate
from .errors import MapErrors
from .survey import judge_survey, read_survey
from .survey_errors import SurveyErrors
from .truth import read_truth

__all__ = [
    "MapErrors",
    "SurveyErrors",
    "evaluate",
    "judge_survey",
    "read_survey",
    "read_truth",
]

from .against_truth import evaluate
from .errors import MapErrors
from .survey import evaluate_survey
from .survey_errors import SurveyErrors
from .survey_file import read_survey
from .truth import read_truth

__all__ = [
    "MapErrors",
    "SurveyErrors",
    "evaluate",
    "evaluate_survey",
    "read_survey",
    "read_truth",
]

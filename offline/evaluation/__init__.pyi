from .against_truth import evaluate
from .errors import MapErrors
from .survey import evaluate_survey
from .survey_errors import ComponentSurvey, EntryResult, SurveyErrors
from .survey_file import SurveyEntry, read_survey
from .survey_frame import align_survey
from .truth import read_truth

__all__ = [
    "ComponentSurvey",
    "EntryResult",
    "MapErrors",
    "SurveyEntry",
    "SurveyErrors",
    "align_survey",
    "evaluate",
    "evaluate_survey",
    "read_survey",
    "read_truth",
]

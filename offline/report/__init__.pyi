from .accuracy_texts import headline
from .picture import write_picture
from .report import write_report
from .sentences import advice_sentence, heading_sentence
from .survey_picture import write_survey_picture
from .verdict import contradiction_sentence, verdict_sentence

__all__ = [
    "advice_sentence",
    "contradiction_sentence",
    "heading_sentence",
    "headline",
    "verdict_sentence",
    "write_picture",
    "write_report",
    "write_survey_picture",
]

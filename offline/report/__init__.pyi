from .accuracy_texts import headline, key_figures
from .figures import component_figures
from .page import asset
from .picture import write_picture
from .report import write_report
from .sentences import advice_sentence, heading_sentence, next_step, scale_sentence, would_help
from .survey_picture import write_survey_picture
from .verdict import contradiction_sentence, verdict_sentence

__all__ = [
    "advice_sentence",
    "asset",
    "component_figures",
    "contradiction_sentence",
    "heading_sentence",
    "headline",
    "key_figures",
    "next_step",
    "scale_sentence",
    "verdict_sentence",
    "would_help",
    "write_picture",
    "write_report",
    "write_survey_picture",
]

from .accuracy_texts import headline, key_figures
from .figures import component_figures
from .page import asset
from .picture import write_picture
from .report import write_report
from .sentences import advice_sentences, next_step, would_help
from .survey_picture import write_survey_picture
from .verdict import contradiction_sentence, verdict_sentence

__all__ = [
    "advice_sentences",
    "asset",
    "component_figures",
    "contradiction_sentence",
    "headline",
    "key_figures",
    "next_step",
    "verdict_sentence",
    "would_help",
    "write_picture",
    "write_report",
    "write_survey_picture",
]

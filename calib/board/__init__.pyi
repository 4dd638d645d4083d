from .board import DEFAULT_BOARD, DEFAULT_VIEWS, MARKER_SHARE, Board, CharucoBoard, parse_board
from .detection import board_detector
from .finder import BoardFinder, BoardView
from .missing import why_no_board
from .picture_source import GreyPicture, grey_pictures
from .view_spread import Coverage, SeenBoard, describe_board, region_shares

__all__ = [
    "DEFAULT_BOARD",
    "DEFAULT_VIEWS",
    "MARKER_SHARE",
    "Board",
    "BoardFinder",
    "BoardView",
    "CharucoBoard",
    "Coverage",
    "GreyPicture",
    "SeenBoard",
    "board_detector",
    "describe_board",
    "grey_pictures",
    "parse_board",
    "region_shares",
    "why_no_board",
]

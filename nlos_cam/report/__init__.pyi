__all__ = [
    "Banner",
    "Bullets",
    "Commands",
    "Document",
    "Facts",
    "Picture",
    "Section",
    "State",
    "Table",
    "bullets",
    "commands",
    "figure",
    "figure_of",
    "page",
    "pairs",
    "png",
    "saved_picture",
    "table",
    "write_document",
]

from .document import Banner, Bullets, Commands, Document, Facts, Section, State, Table, write_document
from .html import Picture, bullets, commands, figure, figure_of, page, pairs, png, saved_picture, table

"""croissant.json: what catalogues and loaders of machine learning read of a dataset (MLCommons Croissant 1.0).

Croissant Format Specification 1.0, docs.mlcommons.org/croissant/docs/croissant-spec-1.0.html: "Dataset-level
information", "Resources" (FileObject, FileSet), "RecordSets and Fields". What the specification requires and nobody but
the makers knows (`license`, `url`, `creator`, `datePublished`) is left out, and the datasheet asks for it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

from generator.dataset.production.cards.facts import citation_of, name_of, option, summary_of
from generator.dataset.production.records import GROUND_TRUTH, SOURCES, Description
from generator.files import suffix_of

CONFORMS_TO: Final = "http://mlcommons.org/croissant/1.0"

_CONTEXT: Final = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
"""The context that the specification recommends, "Appendix 1: JSON-LD context"."""

_MEDIA: Final = {
    "png": "image/png",
    "tiff": "image/tiff",
    "exr": "image/x-exr",
    "jxl": "image/jxl",
    "dng": "image/x-adobe-dng",
}
"""Media types of the formats of images; those of OpenEXR and DNG are not registered with IANA."""

_TRUTH_COLUMNS: Final = (
    ("image", "sc:Text", "Name of the image, as in the images' files or shards."),
    ("source", "sc:Text", "Name of the picture that it shows."),
    ("illumination", "sc:Text", "Number of its light in the table, or the mixture of lights."),
    ("r", "sc:Float", "Red of the light on bare paper, linear camera RGB, r + g + b = 1."),
    ("g", "sc:Float", "Green of the light."),
    ("b", "sc:Float", "Blue of the light."),
)


def croissant(description: Description, sums: Mapping[str, str]) -> str:
    """Return the text of croissant.json."""
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": name_of(description),
        "description": summary_of(description),
        "conformsTo": CONFORMS_TO,
        "version": "1.0.0",
        "keywords": ["colour constancy", "white balance", "illumination estimation", "raw images"],
        "citeAs": citation_of(description),
        "isLiveDataset": False,
        "distribution": [
            *(_table_file(name, sums[name]) for name in (GROUND_TRUTH, SOURCES)),
            *_files_of_images(description),
        ],
        "recordSet": [_ground_truth(), *_images(description)],
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _table_file(name: str, sha256: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "encodingFormat": "text/csv",
        "sha256": sha256,
    }


def _files_of_images(description: Description) -> list[dict[str, Any]]:
    """Return the set of files that holds the images: themselves, or the shards that they lie in."""
    suffix, layout = suffix_of(option(description, "format")), option(description, "layout")
    media = _MEDIA.get(str(option(description, "format")), "application/octet-stream")
    if layout == "folder":
        return [_file_set("image-files", [f"images/*{suffix}"], media)]
    parts = [part for part, images in description.splits.items() if images] or ["data"]
    if layout == "parquet":
        return [_file_set("shards", [f"{part}/*.parquet" for part in parts], "application/x-parquet")]
    return [_file_set("shards", [f"{part}/*.tar" for part in parts], "application/x-tar")]


def _file_set(name: str, includes: list[str], media: str) -> dict[str, Any]:
    return {"@type": "cr:FileSet", "@id": name, "name": name, "encodingFormat": media, "includes": includes}


def _ground_truth() -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": "ground_truth",
        "name": "ground_truth",
        "description": "The lights of the images: a row a light, in the order of the images.",
        "field": [
            _field("ground_truth", name, kind, text, {"fileObject": {"@id": GROUND_TRUTH}, "extract": {"column": name}})
            for name, kind, text in _TRUTH_COLUMNS
        ],
    }


def _images(description: Description) -> list[dict[str, Any]]:
    """Return the records of images: their files, or the columns of their shards.

    Members of several archives that a pattern names cannot be told to loaders; WebDataset's own reader finds them.
    """
    if option(description, "layout") == "webdataset":
        return []
    if option(description, "layout") == "parquet":
        columns = (
            ("number", "sc:Integer", "Number of the image."),
            ("source", "sc:Text", "Name of the picture that it shows."),
            ("width", "sc:Integer", "Width, px."),
            ("height", "sc:Integer", "Height, px."),
        )
        fields = [
            _field("images", name, kind, text, {"fileSet": {"@id": "shards"}, "extract": {"column": name}})
            for name, kind, text in columns
        ]
    else:
        fields = [
            _field(
                "images", "name", "sc:Text", "Name of the file.",
                {"fileSet": {"@id": "image-files"}, "extract": {"fileProperty": "filename"}},
            ),
            _field(
                "images", "content", "sc:ImageObject", "The image, linear camera RGB; keep all 16 bits.",
                {"fileSet": {"@id": "image-files"}, "extract": {"fileProperty": "content"}},
            ),
        ]  # fmt: skip
    return [
        {
            "@type": "cr:RecordSet",
            "@id": "images",
            "name": "images",
            "description": "The images, as they lie in the dataset.",
            "field": fields,
        }
    ]


def _field(record: str, name: str, kind: str, text: str, source: dict[str, Any]) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{record}/{name}",
        "name": name,
        "description": text,
        "dataType": kind,
        "source": source,
    }

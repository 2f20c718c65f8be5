"""Licences of dependencies, as packages or their texts say."""

from pathlib import Path

from experiments import licences

ROOT = Path(__file__).parents[2]


def test_a_licence_is_what_a_package_says_of_it_or_its_text():
    report = {
        "install": [
            {"metadata": {"name": "Torch", "license_expression": "MIT AND Zlib", "license": "long"}},
            {"metadata": {"name": "open3d", "license": "MIT"}},
            {"metadata": {"name": "lab", "license": "a\nb", "classifier": ["License :: OSI Approved :: BSD License"]}},
            {"metadata": {"name": "silent"}},
        ]
    }
    said = {"torch": "MIT AND Zlib", "open3d": "MIT", "lab": "BSD License", "silent": licences.UNSTATED}
    assert licences.read_report(report) == said
    assert licences.kind_of((ROOT / "LICENSE").read_text()) == "MIT"
    two = "Redistribution and use in source and\n   binary forms, with or without modification"
    assert licences.kind_of(two) == "BSD-2-Clause"
    assert licences.kind_of(f"{two} ... Neither the name of the holder") == "BSD-3-Clause"
    assert licences.kind_of("All rights reserved.") == ""

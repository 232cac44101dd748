# SPDX-License-Identifier: MIT
"""What a machine has, and what would mend each lack."""

from __future__ import annotations

import json

from sononerf.run.doctor import as_plain, examine


def by_name(findings):
    return {finding.name: finding for finding in findings}


def test_the_machine_of_the_tests_can_do_all(tmp_path):
    found = by_name(examine(tmp_path))
    assert {"python", "cpu", "memory", "torch", "gpu", "ray casting", "disk"} < set(found)
    assert all(finding.good for finding in found.values())
    assert found["disk"].found.endswith("writes and locks work")
    assert not list(tmp_path.iterdir())
    plain = json.loads(json.dumps(as_plain(list(found.values()))))
    assert plain["good"] is True
    assert plain["findings"][0]["name"] == "python"

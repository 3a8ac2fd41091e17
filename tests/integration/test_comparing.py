"""A comparison of controllers, two of which break: the others' runs are as they always are."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import comparing
from utn_sumo import campaign
from utn_sumo.errors import NetworkError

from . import odd_nets

BROKEN = """
import os

class Raises:
    def __init__(self, network):
        raise RuntimeError("needs\\na licence")

class Dies:
    def __init__(self, network):
        os._exit(3)
"""


@pytest.mark.long
def test_a_controller_that_breaks_leaves_the_others_alone_and_is_tried_again(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text(BROKEN, encoding="utf-8")
    names = [f"{tmp_path / 'broken.py'}:Dies", "fixed", f"{tmp_path / 'broken.py'}:Raises"]
    jobs = comparing.jobs(["utn17"], ["1.0"], names, [1], 0.1)
    record, ticks = tmp_path / "runs.jsonl", []
    died, fixed, raised = comparing.results(jobs, 2, record, lambda: ticks.append(1))
    assert died == {campaign.FAILED: "its process died"}
    assert raised[campaign.FAILED].endswith("can't be built: RuntimeError: needs a licence")
    alone = campaign.measures(jobs[1])
    same = ("total_delay_veh_h", "total_time_spent_veh_h", "arrived", "unfinished")
    assert [fixed[name] for name in same] == [alone[name] for name in same]
    assert len(ticks) == 3

    again = comparing.results(jobs, 2, record, lambda: ticks.append(1))
    assert again[1] == fixed
    lines = [json.loads(line)["job"]["controller"] for line in record.read_text(encoding="utf-8").splitlines()]
    assert len(lines) == 5
    assert lines.count("fixed") == 1


def test_of_several_nets_the_one_is_named_that_can_not_be_read(tmp_path: Path) -> None:
    refused = str(odd_nets.no_internal_links(tmp_path))
    with pytest.raises(NetworkError, match="internal links") as raised:
        comparing.jobs(["utn17", refused], ["1.0"], ["fixed"], [1], 0.1)
    assert refused in str(raised.value)

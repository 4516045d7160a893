from pathlib import Path

from surfkit.plugin import Job
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_what_needs_the_most_memory_is_first():
    jobs = [Job(index, Path(), lambda: 0, (), memory_bytes=size) for index, size in enumerate((10, 30, 20))]
    assert [result.job.index for result in NewPart().run(jobs)] == [1, 2, 0]

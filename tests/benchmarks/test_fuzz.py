"""Every reader answers any damage with its object or with the project's error."""

from benchmarks.fuzz import parts as fuzz
from benchmarks.fuzz.readers import READERS

COUNT = 150  # python -m benchmarks fuzz --count 20000 reads many more


def test_every_reader_reads_damaged_files_or_refuses_them():
    said = []
    counts, failures = fuzz.fuzz(COUNT, seed=5, tell=said.append)
    assert not failures, "\n".join(said)
    assert set(counts) == set(READERS)
    assert sum(sum(found.values()) for found in counts.values()) >= COUNT


def test_damage_is_the_same_for_the_same_seed():
    one, again, other = (fuzz._generator(seed, "a", 3).random() for seed in (0, 0, 1))
    assert one == again != other

"""Sets of vertices that might be seen."""

from mvest.observation.vertices import vertex_sets


def test_sets_of_vertices():
    # Vertices row by row, the annulus first.
    rows = {name: members.reshape(7, 12) for name, members in vertex_sets(12, 7).items()}
    assert rows["all vertices"].all()
    assert [int(r.any()) for r in rows["belly (middle third)"]] == [0, 0, 1, 1, 1, 0, 0]
    assert [int(r.any()) for r in rows["free edge"]] == [0, 0, 0, 0, 0, 0, 1]
    assert [int(r.any()) for r in rows["annulus and free edge"]] == [1, 0, 0, 0, 0, 0, 1]
    assert rows["20 landmarks"].sum(axis=1).tolist() == [0, 0, 0, 10, 0, 0, 10]

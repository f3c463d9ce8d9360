"""Traffic on roads of one's own: OpenDRIVE, OpenStreetMap and SUMO files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from symphony.data.generate import Plan, generate
from symphony.data.sources.sumo.networks import kind_name, own_network, town
from symphony.data.sources.sumo.process import run_program
from symphony.data.sources.sumo.roads import read_network
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError

pytest.importorskip("sumo")

OSM = """<osm version="0.6">
{nodes}
<way id="1">{west}<tag k="highway" v="residential"/></way>
<way id="2">{south}<tag k="highway" v="residential"/></way>
<way id="3"><nd ref="6"/><nd ref="7"/><tag k="highway" v="footway"/></way>
</osm>"""


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same town as SUMO's network and as OpenDRIVE."""
    folder = tmp_path_factory.mktemp("roads")
    made = town(np.random.default_rng(3), folder)
    run_program("netconvert", f"--sumo-net-file {made.name} --opendrive-output town.xodr", folder)
    return {"sumo": made, "opendrive": (folder / "town.xodr").rename(folder / "own town.xodr")}


def driven_length(file: Path) -> float:
    """Metres of lane for traffic."""
    _, length, lanes = read_network(file).edge_graph()
    return float((length * lanes).sum())


def test_opendrive_holds_the_roads_that_it_was_made_of(networks: dict[str, Path], tmp_path: Path) -> None:
    again = own_network(networks["opendrive"], tmp_path)
    assert driven_length(again) == pytest.approx(driven_length(networks["sumo"]), rel=0.1)
    assert len(read_network(again).centers) == pytest.approx(
        len(read_network(networks["sumo"]).centers), abs=3
    )


def test_traffic_of_ours_drives_on_them(networks: dict[str, Path], tmp_path: Path) -> None:
    plan = Plan(3, kinds=(str(networks["opendrive"]),))
    assert generate(plan, tmp_path / "store").complete
    store = SegmentStore(tmp_path / "store")
    assert [name.split("-")[1] for name in store.ids] == ["own_town"] * 3
    assert all(len(store[i].road.lane_type) for i in range(3))
    # Equal arguments give equal stores, and another seed other traffic.
    generate(plan, tmp_path / "again")
    assert SegmentStore(tmp_path / "again").checksum() == store.checksum()
    generate(Plan(3, seed=1, kinds=plan.kinds), tmp_path / "other")
    assert SegmentStore(tmp_path / "other").checksum() != store.checksum()


def test_another_file_of_the_same_name_is_another_plan(networks: dict[str, Path], tmp_path: Path) -> None:
    file = tmp_path / "town.xodr"
    file.write_bytes(networks["opendrive"].read_bytes())
    plan = Plan(1, kinds=(str(file),))
    generate(plan, tmp_path / "store")
    file.write_bytes(file.read_bytes() + b"\n")
    with pytest.raises(ConfigError, match="made with roads"):
        generate(plan, tmp_path / "store")


def test_streets_of_openstreetmap_are_driven_and_footways_are_not(tmp_path: Path) -> None:
    """Two streets of 600 m that cross, and a footway."""
    places = {1: (0, -3), 2: (0, 0), 3: (0, 3), 4: (-3, 0), 5: (3, 0), 6: (1, 1), 7: (2, 2)}
    nodes = [
        f'<node id="{k}" lat="{48 + 0.0009 * x:.6f}" lon="{9 + 0.00134 * y:.6f}"/>'
        for k, (x, y) in places.items()
    ]
    west, south = ("".join(f'<nd ref="{k}"/>' for k in way) for way in ((1, 2, 3), (4, 2, 5)))
    file = tmp_path / "streets.osm"
    file.write_text(OSM.format(nodes="\n".join(nodes), west=west, south=south))
    network = read_network(own_network(file, tmp_path))
    assert len(network.centers) == 1
    assert driven_length(tmp_path / "net.net.xml") == pytest.approx(4 * 600, rel=0.1)
    assert len(network.sources()) == 4


@pytest.mark.parametrize("text", ["", "<OpenDRIVE/>", "<nothing", "\0"])
def test_what_is_no_map_is_an_error_that_names_it(tmp_path: Path, text: str) -> None:
    file = tmp_path / "roads.xodr"
    file.write_text(text)
    with pytest.raises(DataError, match=r"roads\.xodr"):
        own_network(file, tmp_path)
    with pytest.raises(ConfigError, match="there is no file"):
        Plan(1, kinds=("nowhere.xodr",))


def test_names_of_files_can_stand_in_names_of_segments() -> None:
    assert kind_name("/a b/Straße 1.net.xml") == "Stra_e_1"
    assert kind_name("town") == "town"

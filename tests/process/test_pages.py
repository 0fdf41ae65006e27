# SPDX-License-Identifier: Apache-2.0
"""The pages are true: their commands and programs run as they stand, one after the other.

The lines that make a virtual environment are run, exactly as they stand, by ``slow/test_first_steps.py``
from a clone, and by ``.ci/run``; what GATEWAY.md configures, by ``slow/test_gateway.py``.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

import shmmap
from shmmap.daemon.config import load_config
from tests.process.conftest import DaemonFactory
from tests.support.cloud_bytes import write_las
from tests.support.command_line import Shmmap, publish
from tests.support.daemon_process import ROOT, Deadline
from tests.support.divided_map import DividedMap, make_map, random_points, write_pcd
from tests.support.map_stores import KEYS, BucketServer
from tests.support.pages import Terminal, read_page, reader_with_programs
from tests.support.web_servers import faulty_web, free_port

README = read_page("README.md")
START = read_page(".github/site/START.md")
BRIDGE = read_page("clients/shmmap_clients/ros_bridge/ROS_BRIDGE.md")
CLIENTS = read_page("clients/README.md")
LAYERS = read_page("shmmap/layers/LAYERS.md")
LIVE_MAPS = read_page("shmmap/client/live/LIVE_MAPS.md")
PUBLISHING = read_page("shmmap/publishing/PUBLISHING.md")
SERVING = read_page("shmmap/publishing/SERVING_FROM_A_BUCKET.md")
SLICES = read_page("shmmap/publishing/SLICES.md")


@pytest.mark.parametrize(
    ("extra", "install"),
    [
        ("remote", PUBLISHING.commands("install")[0]),
        ("remote", SERVING.commands("install")[0]),
        ("remote", SLICES.commands("install")[0]),
        ("sign", PUBLISHING.commands("install-sign")[0]),
        ("las", read_page("shmmap/dividing/OWN_CLOUD.md").commands("install")[0]),
        ("opencl", CLIENTS.commands("device")[0].partition("#")[0].replace("install", "install -q")),
        ("ros", BRIDGE.commands("install")[0].replace("install", "install -q")),
        ("sign", "pip install -q" + re.findall(r"`pip install( tuf [^`]+)`", SERVING.text)[0]),
    ],
)
def test_packages_are_those_of_the_extra(extra: str, install: str) -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (packages,) = re.findall(rf"^{extra} = \[\n(.*?)^\]", project, re.MULTILINE | re.DOTALL)
    named = [word.partition(">=")[0] for word in shlex.split(install)[3:]]
    assert named == re.findall(r'"([a-z\[\]]+)>=', packages)


def exported(commands: list[str]) -> dict[str, str]:
    """Return the variables that a block sets."""
    return dict(line.removeprefix("export ").split("=", 1) for line in commands)


@pytest.fixture
def user(tmp_path: Path) -> Iterator[Terminal]:
    """A terminal of a reader with the programs of this tree."""
    with reader_with_programs(tmp_path) as reader:
        yield reader.terminal()


@pytest.fixture
def publisher(tmp_path: Path, buckets: BucketServer) -> Iterator[Terminal]:
    """A terminal of a reader with a town and a bucket."""
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    given = exported(PUBLISHING.commands("credentials"))
    assert given == exported(SLICES.commands("credentials"))
    assert given["AWS_ENDPOINT_URL"].startswith("http://127.0.0.1:")
    assert given.keys() <= buckets.environment.keys()
    assert exported(SERVING.commands("credentials")).keys() <= buckets.environment.keys()
    with reader_with_programs(tmp_path, **buckets.environment) as reader:
        yield reader.terminal(ROOT)


# --- README.md -----------------------------------------------------------------------------------------


def test_the_readme_is_short() -> None:
    assert len(README.text.encode()) < 6000
    assert len([line for line in README.blocks["points"] if line]) == 3


def test_two_lines_do_everything() -> None:
    (demo,), (tests,) = README.commands("demo"), README.commands("tests")
    (everything,) = read_page("shmmap/INSTALL.md").commands("everything")
    (for_tests,) = read_page("tests/benchmarks/BENCHMARKS.md").commands("install")
    assert demo == f"{everything} && shmmap demo"
    assert tests == f"{for_tests} && pytest -q"


def test_three_lines_for_ros() -> None:
    """ROS has numpy; the others are those of the client-only install."""
    _, install, node = README.commands("ros")
    packages, ours = re.findall(r"pip install -q ([^&]+)", install)
    (client_only,) = read_page("shmmap/INSTALL.md").commands("client-only")
    assert f" numpy {packages.strip()} " in client_only
    assert ours == "--no-deps ."
    assert f'\n{node} = "' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_measured_rows_name_their_benchmarks() -> None:
    table = README.text.partition("## Measured")[2].partition("\n## ")[0]
    names = re.findall(r"\| `tests\.benchmarks\.(\w+)` \|$", table, re.MULTILINE)
    assert len(names) == 5
    for name in names:
        assert (ROOT / "tests" / "benchmarks" / f"{name}.py").is_file(), name


@pytest.fixture(scope="module")
def newcomer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Terminal]:
    """Follow the server's part of the README; the daemon runs in another terminal until the end."""
    with reader_with_programs(tmp_path_factory.mktemp("readme")) as reader:
        first = reader.terminal()
        demo, serve = README.commands("server")
        assert demo.startswith("shmmap demo ")
        first.run(f"{demo} --density 20")  # in a fifth of the time; as it stands: test_first_steps.py
        with first.serving(serve):
            yield reader.terminal()


def test_commands_of_a_user(newcomer: Terminal) -> None:
    status, query = re.findall(r"`(shmmap (?:status|query)[^`]*)`", README.text)
    assert "healthy" in newcomer.run(status)
    assert "town_160_160.pcd" in newcomer.run(query)


def test_what_is_in_memory(newcomer: Terminal) -> None:
    status, ls, clients = map(newcomer.run, read_page("shmmap/daemon/MEMORY.md").commands("look"))
    assert "healthy" in status
    assert "town_" in ls
    assert clients


def test_programs_of_the_readme(newcomer: Terminal) -> None:
    number = re.fullmatch(r"(\d+) points\n", newcomer.python(README.blocks["points"]))
    assert number is not None
    assert int(number[1]) > 10_000


# --- START.md -----------------------------------------------------------------------------------------


def test_a_cloud_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("laspy", reason="laspy is not installed")
    install, view = START.commands("picture")
    assert [install] == read_page("shmmap/dividing/OWN_CLOUD.md").commands("install")
    x, y = np.random.default_rng(0).uniform(0.0, 60.0, (2, 3000))
    write_las(tmp_path / "city.las", {"x": x, "y": y, "z": x / 30.0, "intensity": y})
    with reader_with_programs(tmp_path) as reader:
        assert "wrote city.png: 3,000 points of 1 file" in reader.terminal().run(view)
    assert (tmp_path / "city.png").read_bytes().startswith(b"\x89PNG")


def test_a_map_is_served_looked_at_and_followed(newcomer: Terminal) -> None:
    """The daemon is that of the README's lines; there the terminal is at home, too."""
    assert START.commands("serve") == [line.replace(" town", " ~/town") for line in README.commands("server")]
    status, query, view = map(newcomer.run, START.commands("look"))
    assert "healthy" in status
    assert "town_160_160.pcd" in query
    assert "wrote place.png: " in view
    numbers = re.fullmatch(r"(\d+) cells, (\d+) points near\n", newcomer.python(START.blocks["window"]))
    assert numbers is not None
    assert int(numbers[1]) > 30
    assert int(numbers[2]) > 10_000


def test_the_same_program_follows_a_vehicle_on_another_map(
    daemon: DaemonFactory, divided_map: DividedMap, user: Terminal
) -> None:
    one = daemon(divided_map.root)
    user.run(f"export SHMMAP_ENDPOINT='{one.endpoint}' SHMMAP_SHM_DIR='{one.shm_dir}'")
    assert re.fullmatch(r"[1-9]\d* cells, [1-9]\d* points near\n", user.python(START.blocks["window"]))


# --- C++, LAYERS.md ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_from_cpp(newcomer: Terminal, tmp_path: Path) -> None:
    """The program counts what the three lines of Python count; what is shown compiles as it stands."""
    if shutil.which("g++") is None:
        pytest.skip("g++ is missing")
    build, run = README.commands("cpp-run")
    newcomer.run(f"ln -s '{ROOT}/clients'")  # the reader is in the clone
    newcomer.run(build)
    python = newcomer.python(README.blocks["points"])
    assert newcomer.run(run).startswith(python.replace("\n", " in "))
    shown = tmp_path / "drive.cpp"
    shown.write_text("\n".join(README.blocks["cpp"]) + "\n", encoding="utf-8")
    newcomer.run(
        f"g++ -std=c++17 -c -Wall -Wextra -Werror $(shmmap cpp --includes) '{shown}' -o '{tmp_path}/drive.o'"
    )


def test_a_layer(newcomer: Terminal) -> None:
    printed = newcomer.python(LAYERS.blocks["layers"]).splitlines()
    assert len(printed) >= 4
    for line in printed:
        found = re.fullmatch(r"\((\d+), 3\) \((\d+), 6\) Lattice\(leaf=\(2.0, 2.0, 2.0\), .*\)", line)
        assert found is not None, line
        assert found[1] == found[2]


def test_a_kind_of_layer_of_one_s_own_without_a_daemon(user: Terminal, tmp_path: Path) -> None:
    """The page's entry point, of a package that is installed; a layer of a file."""
    entry_points = tomllib.loads("\n".join(LAYERS.blocks["entry-point"]))["project"]["entry-points"]
    ((group, kinds),) = entry_points.items()
    ((name, value),) = kinds.items()
    module = tmp_path / "packages" / f"{value.partition(':')[0].replace('.', '/')}.py"
    module.parent.mkdir(parents=True)
    shutil.copy(ROOT / "clients/examples/roughness_layer.py", module)
    information = tmp_path / "packages" / "my_package-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(f"[{group}]\n{name} = {value}\n")
    points = random_points(np.random.default_rng(1), (0, 0), 500)
    write_pcd(tmp_path / "cloud.pcd", points)
    user.run(f"export PYTHONPATH='{tmp_path}/packages':$PYTHONPATH")
    (program,) = LAYERS.commands("program")
    user.run(program.replace("ndt(leaf=2.0)", "roughness(edge=4.0)"))
    with np.load(tmp_path / "ndt.npz") as found:
        assert "roughness" in found
        assert 0 < len(found["roughness"]) <= 25


@pytest.mark.usefixtures("layer_kernels")
def test_a_layer_of_a_file(user: Terminal, tmp_path: Path) -> None:
    points = random_points(np.random.default_rng(1), (0, 0), 500)
    write_pcd(tmp_path / "cloud.pcd", points)
    user.run(LAYERS.commands("program")[0])
    with np.load(tmp_path / "ndt.npz") as found:
        assert 0 < found["count"].sum() <= 500


# --- clients/README.md --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("ndt", r"\d+ Gaussians, NVTL \d"),
        ("pose-init", r"score \d+\.\d+, reliable: (True|False)"),
        ("compare", r"\d{4,6} points are not in the map"),
        ("elevation", r"lowest points ahead: \[.*\d"),
        ("elevation-whole", r"36 cells, \d+ of \d+ columns"),
    ],
)
def test_an_example_of_the_clients(
    daemon: DaemonFactory, divided_map: DividedMap, user: Terminal, name: str, printed: str
) -> None:
    program = CLIENTS.blocks[name]
    assert len([line for line in program if line.strip()]) <= 12
    one = daemon(divided_map.root)
    user.run(f"export SHMMAP_ENDPOINT='{one.endpoint}' SHMMAP_SHM_DIR='{one.shm_dir}'")
    assert re.search(printed, user.python(program))


# --- LIVE_MAPS.md -------------------------------------------------------------------------------------


def test_what_a_live_map_costs_is_said_by_resolution_and_range(tmp_path: Path) -> None:
    """The settings are settings, with a resolution of the table; the command measures one of its places."""
    file = tmp_path / "shmmap.toml"
    file.write_text("\n".join(LIVE_MAPS.blocks["settings"]))
    (settings,) = load_config({}, file=str(file), environ={}).live
    lines = [line for line in LIVE_MAPS.text.splitlines() if re.match(r"\| (voxels|[\d.]+ m) \|", line)]
    head, *rows = ([word.strip() for word in line.strip("|").split("|")] for line in lines)
    ranges = [word.removeprefix("rays of ").removesuffix(" m") for word in head[1:]]
    costs = {
        f"{row[0].removesuffix(' m')}/{metres}": cost
        for row in rows
        for metres, cost in zip(ranges, row[1:], strict=True)
        if cost
    }
    assert all(re.fullmatch(r"\d+ ms, \d+ MB", cost) for cost in costs.values())
    assert f"{settings.resolution:g}/30" in costs
    (measured,) = re.findall(r"tests\.benchmarks\.live_insertion --alone --setting (\S+)`", LIVE_MAPS.text)
    assert measured in costs


def test_a_wall_is_mapped_and_read(tmp_path: Path) -> None:
    (serve,) = LIVE_MAPS.commands("serve")
    with reader_with_programs(tmp_path) as reader, reader.terminal().serving(serve):
        user = reader.terminal()
        assert user.python(LIVE_MAPS.blocks["map"]) == "5 scans applied\n"
        listed, free, ray = user.python(LIVE_MAPS.blocks["read"]).splitlines()
        voxels = re.fullmatch(r"(\d+) voxels, up to (0\.\d+)", listed)
        assert voxels is not None
        assert int(voxels[1]) > 1000
        assert float(voxels[2]) == pytest.approx(0.97, abs=0.02)
        assert free == "free at 1 m: True"
        assert re.fullmatch(r"a ray gets to (3\.0|3\.1|2\.9) m", ray)
        assert "lidar" in user.run("shmmap live ls")
        assert "on the disk" in user.run("shmmap live save lidar")
        user.run("shmmap live export maps/lidar -o wall.ply")


# --- PUBLISHING.md ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("layer_kernels")
def test_a_map_is_published_fetched_and_goes_back(publisher: Terminal, tmp_path: Path) -> None:
    made = make_map(tmp_path / "town", columns=2, rows=2, points=300)
    run = publisher.run
    publishing, versions = PUBLISHING.commands("publish")
    assert "version  1\n" in run(publishing)
    assert "current" in run(versions)
    made.change("0_0.pcd", seed=5, count=300)
    assert "sent     4 objects" in run(publishing)
    into_directory, serve = PUBLISHING.commands("directory")
    assert "/town/..." in run(into_directory)
    port = free_port()
    with publisher.web_server(serve.replace("8000", str(port)), port):
        listed, fetched = (run(line.replace("8000", str(port))) for line in PUBLISHING.commands("fetch"))
    assert "current" in listed
    assert "4 cells, 1,200 points" in fetched
    back = tmp_path / "back/pointcloud_map.pcd"
    for name in made.corners:
        assert (back / name).read_bytes() == (made.pcd_dir / name).read_bytes()
    rolled_back, pruned = map(run, PUBLISHING.commands("versions"))
    assert rolled_back == "version 3 is current: the content of version 1\n"
    assert "removed  no version; 0 objects" in pruned
    pytest.importorskip("tuf", reason="tuf is not installed")
    run(f"export XDG_STATE_HOME='{tmp_path}/state'")
    signed, refreshed, listed, verified = map(run, PUBLISHING.commands("sign"))
    assert "version  1\n" in signed
    assert "version 1 is signed" in refreshed
    assert "version 1 is signed, until" in listed
    assert "4 cells, 1,200 points" in verified
    (rotated,) = map(run, PUBLISHING.commands("rotate"))
    assert rotated.startswith("targets: signed by a new key, as root of trust 3 says\n")
    assert "version 1 is signed, until" in run(PUBLISHING.commands("sign")[2])


# --- SERVING_FROM_A_BUCKET.md -------------------------------------------------------------------------


def test_settings_are_settings(tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text("\n".join(SERVING.blocks["settings"]))
    config = load_config({}, file=str(file), environ={})
    assert (config.map_path, config.poll_s) == ("s3://maps/town", 60.0)
    assert config.catalogue_budget_bytes == 256 << 20


@pytest.mark.slow
@pytest.mark.usefixtures("layer_kernels")
def test_a_map_is_served_from_a_bucket(buckets: BucketServer, daemon: DaemonFactory, tmp_path: Path) -> None:
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    made = make_map(tmp_path / "town", columns=2, rows=2, points=4000)
    publish(made.root, buckets.url("vehicle/town"))
    (serve,) = SERVING.commands("serve")
    assert serve == f"shmmap serve {buckets.url('town')}"
    serve = serve.replace("maps/", "maps/vehicle/")  # the bucket has what other tests have published
    one = daemon(serve.split()[2], environment=buckets.environment)
    run = Shmmap(one, tmp_path)
    query, health, reload = (run(*shlex.split(line)[1:]) for line in SERVING.commands("ask"))
    assert all(name in query for name in made.corners)
    assert "ndt(leaf=2.0" in query
    assert health.startswith("healthy")
    assert reload.startswith("0 cells changed")


def is_shown(line: str, text: str) -> bool:
    """Whether a line of the page is printed, apart from its numbers, times and blanks."""
    fixed = re.split(r"\d+(?:\.\d+)? [smhd]\b|\d+", " ".join(line.split()))
    pattern = r"[\w. ]+?".join(re.escape(part) for part in fixed)
    return re.search(pattern, " ".join(text.split())) is not None


def test_the_link_is_down(daemon: DaemonFactory, tmp_path: Path) -> None:
    """The page's commands, their output, and which cells are served meanwhile."""
    pytest.importorskip("obstore", reason="obstore is not installed")
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    made = make_map(tmp_path / "files", columns=2, rows=2, points=300)
    publish(made.root, tmp_path / "www/maps/town")
    (serve,) = SERVING.commands("serve")
    everywhere = shmmap.Box(-1e6, -1e6, 1e6, 1e6)
    with faulty_web(tmp_path / "www") as web:
        one = daemon(serve.split()[2], "--poll", "1", environment={**KEYS, "AWS_ENDPOINT_URL": web.url})
        verbs, waiting = Shmmap(one, tmp_path), Deadline()
        verbs.environment["COLUMNS"] = "400"
        is_healthy = ("health", "--strict")
        with shmmap.connect(one.endpoint) as client:
            near = client.around(-15.0, -15.0, 2.0, wait=60.0)
            assert near.complete
            while waiting(not list(one.state_dir.rglob("*.taken"))):
                pass
            web.refuse()
            while waiting(verbs.run(*is_healthy).returncode != 1):
                pass
            cells = client.area(everywhere, wait=60.0)
            assert {failure.code for failure in cells.failed} == {"offline"}
            assert {cell.id for cell in cells} == {cell.id for cell in near}
            *looks, tail = (shlex.split(line)[1:] for line in SERVING.commands("down"))
            assert [words[0] for words in looks] == ["health", "status", "doctor"]
            for words in looks:
                text = verbs(*words, code=1 if words[0] == "health" else 0)
                for line in SERVING.blocks[words[0]]:
                    assert is_shown(line, text), f"{line}\n\n{text}"
            assert "offline" in verbs(*tail)
            with pytest.raises(shmmap.Offline):
                client.reload()
            del cells
        one.stop()
        one.start()
        with shmmap.connect(one.endpoint) as client:
            again = client.around(-15.0, -15.0, 2.0, wait=60.0)
            assert {cell.version for cell in again} == {cell.version for cell in near}
            while waiting(one.log.count("the map's origin is out of reach") < 2):  # in each run once
                pass
            web.listen()
            while waiting(not client.area(everywhere, wait=5.0).complete):
                pass
        for line in SERVING.blocks["log"]:
            while waiting(not is_shown(line, one.log)):
                pass
        while waiting(verbs.run(*is_healthy).returncode != 0):
            pass


@pytest.mark.slow
def test_a_signed_map_is_served(buckets: BucketServer, daemon: DaemonFactory, tmp_path: Path) -> None:
    pytest.importorskip("tuf", reason="tuf is not installed")
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    made = make_map(tmp_path / "town", columns=2, rows=1, points=100)
    keys = tmp_path / "keys"
    publish(made.root, buckets.url("vehicle/signed"), "--sign", str(keys))
    _, _, url, option, root = shlex.split(SERVING.commands("trust")[0])
    assert (url, root) == (buckets.url("signed"), "ROOT.json")
    words = url.replace("maps/", "maps/vehicle/"), option, str(keys / root)
    one = daemon(*words, environment=buckets.environment)
    with shmmap.connect(one.endpoint) as client:
        assert client.around(0, 0, radius=500, wait=60.0).complete
    secret = buckets.environment["AWS_SECRET_ACCESS_KEY"]
    kept = [path for path in one.state_dir.rglob("*") if path.is_file()]
    assert kept
    assert not [path for path in kept if secret.encode() in path.read_bytes()]


# --- SLICES.md ----------------------------------------------------------------------------------------


class Slices:
    """Runs the page's commands on a map of its own in the bucket."""

    def __init__(self, terminal: Terminal, name: str) -> None:
        self._terminal, self._name = terminal, name

    def __call__(self, script: str) -> str:
        return self._terminal.run(script.replace("maps/town", self._name))


@pytest.fixture
def slices(publisher: Terminal, layer_kernels: None, tmp_path: Path) -> Slices:
    """A town of four shards in the bucket, whose layers are to be made."""
    make_map(tmp_path / "town", columns=2, rows=2, points=300)
    run = Slices(publisher, f"maps/{tmp_path.name}")
    run(SLICES.commands("by-hand")[0])
    return run


def run_in(text: str) -> str:
    """Return the name of the run that a slice prints."""
    (found,) = set(re.findall(r"^run +(\S+)$", text, re.MULTILINE))
    return str(found)


@pytest.mark.slow
def test_slices_by_hand(slices: Slices) -> None:
    _, *commands, join = SLICES.commands("by-hand")
    run = run_in("\n".join(map(slices, commands)))
    joined = slices(join.replace("RUN", run))
    assert "version  2\nlayers   ndt(leaf=2.0) points\njoined   2 slices\n" in joined


@pytest.mark.slow
def test_slices_by_gnu_parallel(slices: Slices) -> None:
    program = shutil.which("parallel")
    if program is None or "GNU parallel" not in subprocess.check_output([program, "--version"], text=True):
        pytest.skip("GNU parallel is not installed")
    (command,) = SLICES.commands("parallel")
    run = run_in(slices(command))
    assert run.endswith("-4")
    assert "joined   4 slices" in slices(f"shmmap publish s3://maps/town --join {run}")


@pytest.mark.slow
def test_the_script_for_slurm_and_the_manifest_for_kubernetes_make_their_slices(slices: Slices) -> None:
    """Of four shards in 64 slices the second is in the 17th; nothing is in the 18th."""
    script = "\n".join(SLICES.blocks["slurm"])
    assert "--array=1-64 " in script
    made = slices(f"export SLURM_ARRAY_TASK_ID=17\n{script}")
    assert "17 of 64, 1 cell\n" in made
    job = yaml.safe_load(SLICES.path.with_name("slices.kubernetes.yaml").read_text(encoding="utf-8"))
    assert (job["kind"], job["spec"]["completions"], job["spec"]["completionMode"]) == ("Job", 64, "Indexed")
    (container,) = job["spec"]["template"]["spec"]["containers"]
    assert container["command"] == ["sh", "-c"]
    (command,) = container["args"]
    again = slices(f"export JOB_COMPLETION_INDEX=16\n{command}")
    assert "17 of 64, 1 cell: it had been made before\n" in again
    empty = slices(f"export JOB_COMPLETION_INDEX=17\n{command}")
    assert "18 of 64, 0 cells\n" in empty
    assert run_in(made) == run_in(again) == run_in(empty)


@pytest.mark.slow
def test_slices_by_dask_on_this_machine(slices: Slices, tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    install, example = SLICES.commands("dask")
    assert install == "pip install -q distributed"
    assert "clients/examples/slices_with_dask.py" in example
    printed = slices(f"export DASK_TEMPORARY_DIRECTORY='{tmp_path}/dask'\n{example}")
    assert printed.count(" bytes sent") == 4
    assert "joined   4 slices" in printed

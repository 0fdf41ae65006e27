# SPDX-License-Identifier: Apache-2.0
"""A real Prometheus takes the metrics, and its alert fires when the daemon is killed.

``SHMMAP_TEST_PROMETHEUS`` names the directory of ``prometheus`` and ``promtool``: Debian's package, unpacked.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, Deadline
from tests.support.divided_map import DividedMap
from tests.support.metrics import listening
from tests.support.web_servers import free_port

ALERTS = ROOT / "systemd/prometheus/alerts.yml"


@pytest.fixture(scope="module")
def tools() -> dict[str, str]:
    where = os.environ.get("SHMMAP_TEST_PROMETHEUS", os.environ["PATH"])
    found = {name: shutil.which(name, path=where) for name in ("prometheus", "promtool")}
    if None in found.values():
        pytest.skip("there is no Prometheus here: SHMMAP_TEST_PROMETHEUS")
    return {name: str(path) for name, path in found.items()}


def promtool(tools: dict[str, str], *words: str, text: str = "", cwd: Path | None = None) -> str:
    done = subprocess.run([tools["promtool"], *words], input=text, capture_output=True, text=True, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_names_and_rules_are_sound(
    tools: dict[str, str], daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    with listening(one) as url, urllib.request.urlopen(url, timeout=20) as answer:
        assert promtool(tools, "check", "metrics", text=answer.read().decode()) == ""
    assert "SUCCESS: 12 rules found" in promtool(tools, "check", "rules", str(ALERTS))
    shutil.copy(ALERTS, tmp_path)
    (tmp_path / "test.yml").write_text(RULE_TESTS)
    assert "SUCCESS" in promtool(tools, "test", "rules", "test.yml", cwd=tmp_path)


RULE_TESTS = """\
rule_files: [alerts.yml]
evaluation_interval: 1m
tests:
  - interval: 1m
    input_series:
      - {series: 'shmmap_up{daemon="car"}', values: '1 1 0 0 0 0'}
      - {series: 'shmmap_refused_over_budget_total{daemon="car"}', values: '0 0+5x12'}
      - {series: 'shmmap_refused_over_budget_total{daemon="bus"}', values: '7x12'}
      - {series: 'shmmap_live_failing{daemon="car", map="lidar"}', values: '0 1x11'}
      - {series: 'shmmap_published_expires_timestamp_seconds{daemon="car"}', values: '86000x20'}
      - {series: 'shmmap_published_expires_timestamp_seconds{daemon="bus"}', values: '200000x20'}
    alert_rule_test:
      - {eval_time: 2m, alertname: ShmmapDown, exp_alerts: []}
      - eval_time: 4m
        alertname: ShmmapDown
        exp_alerts:
          - exp_labels: {severity: critical, daemon: car}
            exp_annotations:
              summary: The map daemon car is down or hangs
              description: >-
                `shmmap health` says how, `systemctl status shmmapd` why. Clients keep the cells that they
                have.
      - eval_time: 10m
        alertname: ShmmapMemoryFull
        exp_alerts:
          - exp_labels: {severity: critical, daemon: car}
            exp_annotations:
              summary: "Cells are refused: the memory of car is full"
              description: >-
                `shmmap status` names who holds it; raise the budget, or let clients ask for less.
      - eval_time: 4m
        alertname: ShmmapLiveMapFails
        exp_alerts:
          - exp_labels: {severity: critical, daemon: car, map: lidar}
            exp_annotations:
              summary: The live map lidar of car cannot load or save chunks
              description: "`shmmap live ls` names the problem."
      - eval_time: 15m
        alertname: ShmmapSignatureExpires
        exp_alerts:
          - exp_labels: {severity: warning, daemon: car}
            exp_annotations:
              summary: The signature of the map of car expires within a day
              description: "`shmmap versions URL --refresh --sign KEYDIR` renews it."
"""


def test_the_alert_fires_when_the_daemon_is_killed(
    tools: dict[str, str], daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    (tmp_path / "alerts.yml").write_text(ALERTS.read_text().replace("for: 1m", "for: 1s"))
    port = free_port()
    with listening(one) as url:
        target = url.removeprefix("http://").removesuffix("/metrics")
        scrapes = [{"job_name": "shmmap", "static_configs": [{"targets": [target]}]}]
        settings = {
            "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
            "rule_files": ["alerts.yml"],
            "scrape_configs": scrapes,
        }
        (tmp_path / "prometheus.yml").write_text(json.dumps(settings))
        with subprocess.Popen(
            [
                tools["prometheus"], "--config.file=prometheus.yml", "--storage.tsdb.path=data",
                f"--web.listen-address=127.0.0.1:{port}",
            ],
            cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        ) as process:  # fmt: skip
            try:
                waiting = Deadline()
                while waiting(_value(port, "shmmap_up") != "1"):
                    pass
                assert _firing(port) == []
                one.kill()
                waiting = Deadline()
                while waiting("ShmmapDown" not in _firing(port)):
                    pass
            finally:
                process.terminate()


def _asked(port: int, path: str) -> Any:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/v1/{path}", timeout=20) as answer:
            return json.load(answer)["data"]
    except OSError:
        return None  # it is starting


def _value(port: int, name: str) -> str:
    found = _asked(port, f"query?query={name}")
    return found["result"][0]["value"][1] if found and found["result"] else ""


def _firing(port: int) -> list[str]:
    found = _asked(port, "alerts")
    alerts = found["alerts"] if found else []
    return [one["labels"]["alertname"] for one in alerts if one["state"] == "firing"]

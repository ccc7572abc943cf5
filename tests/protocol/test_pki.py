"""`r2rgate pki init`: what it makes opens a real TLS session, lets no stranger in, and is never written over."""

import asyncio
import stat
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from typer.testing import CliRunner

from gateway.cli.certificates import (
    AUTHORITY_DAYS,
    CERTIFICATE_DAYS,
    Authority,
    NoCertificate,
    Pair,
    certificate_of,
    issued,
)
from gateway.cli.doctor_certificates import certificates
from gateway.cli.main import app
from gateway.cli.pki_bus import PkiRefused, keep_bus_pki
from gateway.core.line import Line, Network
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.topics import ASK_STATUS
from gateway.mailbox.bus import BusUnavailable, TlsEndpoint, connect
from tests.protocol.bus_support import LONG_S, client, echo, router, run
from tests.support.ports import free_port

NOW = datetime.now(UTC)
STATUS = ASK_STATUS.of("sysid")


def invoke(folder: Path, *words: str):
    where = ["--line", str(folder / "line.toml"), "--data-dir", str(folder / "data")]
    return CliRunner().invoke(app, ["pki", "init", *where, *words])


def init(folder: Path, *words: str) -> str:
    """What the command says; it must succeed."""
    if not (folder / "line.toml").exists():
        (folder / "line.toml").write_text(line_template(1), encoding="utf-8")
    done = CliRunner().invoke(
        app, ["pki", "init", "--line", str(folder / "line.toml"), "--data-dir", str(folder / "data"), *words]
    )
    assert done.exit_code == 0, done.output
    return done.stdout


def refusal(folder: Path, *words: str) -> str:
    (folder / "line.toml").write_text(line_template(1), encoding="utf-8")
    done = CliRunner().invoke(
        app, ["pki", "init", "--line", str(folder / "line.toml"), "--data-dir", str(folder / "data"), *words]
    )
    assert done.exit_code == 2 and not done.stdout
    return done.stderr


def line_with(folder: Path, said: str, address: str) -> Line:
    """The template's line with the table that the command has printed, on another port."""
    table = said[said.index("[network]") : said.index("\n\nOn the agents")]
    rows = [row if not row.startswith("listen") else f'listen = "tls/{address}"' for row in table.splitlines()]
    text = line_template(1) + "\n" + "\n".join(rows) + "\n"
    (folder / "line.toml").write_text(text, encoding="utf-8")
    return load_line(text, "line.toml")


def as_agent(pki: Path, name: str, address: str) -> TlsEndpoint:
    return TlsEndpoint(address, pki / f"{name}.pem", pki / f"{name}.key.pem", pki / "authority.pem")


@pytest.mark.wires
def test_what_it_makes_opens_a_session_and_lets_no_stranger_in() -> None:
    async def story(folder: Path) -> None:
        stranger = folder / "stranger"
        stranger.mkdir()
        init(stranger)
        address = f"127.0.0.1:{free_port()}"
        line = line_with(folder, init(folder, "--agents", "agents", "--agents", "night"), address)
        assert line.network is not None and line.network.names == ["agents", "night"]
        async with router(folder, line) as gateway:
            gateway.serve(STATUS, echo)
            for name in line.network.names:
                async with client(as_agent(folder / "pki", name, address), line.site, line.line) as agents:
                    assert await agents.request(STATUS, b"1", LONG_S) == b"echo 1"
            forged = as_agent(stranger / "pki", "agents", address)
            deceived = TlsEndpoint(address, forged.certificate, forged.private_key, folder / "pki" / "authority.pem")
            as_server = as_agent(folder / "pki", "gateway", address)  # no certificate for asking
            for where in (forged, deceived, as_server):
                with pytest.raises(BusUnavailable, match="no gateway takes this certificate"):
                    await connect(where, line.site, line.line)

    run(story)


@pytest.mark.wires
def test_the_agents_process_meets_a_gateway_elsewhere_by_its_certificate() -> None:
    async def story(folder: Path) -> None:
        address = f"127.0.0.1:{free_port()}"
        line = line_with(folder, init(folder), address)
        words = ["agents", folder / "line.toml", "--gateway", address, "--certificate", folder / "pki" / "agents.pem"]
        async with router(folder, line):
            child = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "gateway.cli", *words, "--data-dir", folder / "data",
                stdout=asyncio.subprocess.PIPE,
            )  # fmt: skip
            assert child.stdout is not None
            try:
                said = [await child.stdout.readline()]
                while said[-1] and not said[-1].startswith(b"agents of "):
                    said.append(await child.stdout.readline())
                assert said[-1], said
            finally:
                child.terminate()
            assert await child.wait() == 0

    run(story)


def test_an_agents_process_without_all_of_its_files_is_refused(tmp_path: Path) -> None:
    init(tmp_path)
    (tmp_path / "pki" / "agents.key.pem").unlink()
    words = ["agents", str(tmp_path / "line.toml"), "--certificate", str(tmp_path / "pki" / "agents.pem")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2 and "belong together" in done.stderr
    done = CliRunner().invoke(app, [*words, "--gateway", "127.0.0.1:1"])
    assert done.exit_code == 2 and "agents.key.pem" in done.stderr and "pki init" in done.stderr


def test_the_files_are_private_and_say_what_they_are_for(tmp_path: Path) -> None:
    said = init(tmp_path, "--host", "gateway.plant.example", "--host", "192.168.0.5", "--agents", "agents")
    files = sorted((tmp_path / "pki").iterdir())
    assert [path.name for path in files] == [
        "agents.key.pem", "agents.pem", "authority.key.pem", "authority.pem", "gateway.key.pem", "gateway.pem",
    ]  # fmt: skip
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o600}
    gateway = certificate_of((tmp_path / "pki" / "gateway.pem").read_bytes())
    names = gateway.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "gateway.plant.example" in names.get_values_for_type(x509.DNSName)
    assert "192.168.0.5" in map(str, names.get_values_for_type(x509.IPAddress))
    assert 'listen = "tls/gateway.plant.example:7447"' in said
    agents = certificate_of((tmp_path / "pki" / "agents.pem").read_bytes())
    assert agents.subject.rfc4514_string() == "CN=agents"
    authority = certificate_of((tmp_path / "pki" / "authority.pem").read_bytes())
    for one in (gateway, agents):
        one.verify_directly_issued_by(authority)
        assert timedelta(days=CERTIFICATE_DAYS - 1) < one.not_valid_after_utc - NOW < timedelta(days=AUTHORITY_DAYS)


def test_nothing_is_written_over_and_what_is_missing_is_signed_by_the_same_authority(tmp_path: Path) -> None:
    init(tmp_path)
    pki = tmp_path / "pki"
    before = {path.name: path.read_bytes() for path in pki.iterdir()}
    assert "move NAME.pem and NAME.key.pem away" in refusal(tmp_path)
    said = init(tmp_path, "--agents", "agents", "--agents", "night")
    assert "night.pem, night.key.pem (made" in said and "gateway.pem, gateway.key.pem (was there" in said
    for name in ("gateway.pem", "gateway.key.pem"):
        (pki / name).rename(tmp_path / name)
    init(tmp_path)
    now = {path.name: path.read_bytes() for path in pki.iterdir()}
    assert {name for name in before if before[name] != now[name]} == {"gateway.pem", "gateway.key.pem"}
    authority = certificate_of(now["authority.pem"])
    certificate_of(now["gateway.pem"]).verify_directly_issued_by(authority)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--agents", "Night Shift"], "--agents is Night Shift"),
        (["--agents", "authority"], "neither authority nor gateway"),
        (["--agents", "a", "--agents", "a"], "each name once"),
        (["--host", "tls/a:7447"], "--host is tls/a:7447"),
        (["--host", "gät.example"], "--host is gät.example"),
    ],
)
def test_what_cannot_be_a_name_is_refused(tmp_path: Path, words: list[str], said: str) -> None:
    assert said in refusal(tmp_path, *words)
    assert not (tmp_path / "pki").exists()


def test_halves_foreign_files_and_an_authority_whose_time_is_over_are_refused(tmp_path: Path) -> None:
    def keep(now: datetime = NOW) -> None:
        keep_bus_pki(tmp_path, "plant/line", ["127.0.0.1"], ["agents"], now)

    keep()
    whole = {path: path.read_bytes() for path in tmp_path.iterdir()}

    def mended() -> None:
        for path, content in whole.items():
            path.write_bytes(content)

    (tmp_path / "agents.key.pem").unlink()
    with pytest.raises(PkiRefused, match=r"agents\.pem is there without"):
        keep()
    mended()
    (tmp_path / "agents.pem").write_text("no certificate")
    with pytest.raises(PkiRefused, match="is no certificate"):
        keep()
    mended()
    for name in ("agents.pem", "agents.key.pem"):
        (tmp_path / name).unlink()
    with pytest.raises(PkiRefused, match="ended on"):
        keep(NOW + timedelta(days=AUTHORITY_DAYS + 1))
    for name in ("authority.pem", "authority.key.pem"):
        (tmp_path / name).write_bytes((tmp_path / name.replace("authority", "gateway")).read_bytes())
    with pytest.raises(PkiRefused, match="cannot sign: it is the certificate of no authority"):
        keep()
    mended()
    (tmp_path / "authority.key.pem").write_bytes(whole[tmp_path / "gateway.key.pem"])
    (tmp_path / "agents.pem").unlink()
    (tmp_path / "agents.key.pem").unlink()
    with pytest.raises(PkiRefused, match="not that of its certificate"):
        keep()


def test_a_locked_key_is_no_key_of_an_authority() -> None:
    pair = Authority.begin("plant", NOW).pair
    with pytest.raises(NoCertificate, match="without a password"):
        Authority(Pair(pair.certificate, b"-----BEGIN ENCRYPTED PRIVATE KEY-----\n-----END ENCRYPTED PRIVATE KEY-----"))


def looked_at(folder: Path, days: float, **changes: str) -> dict[str, tuple[str, str]]:
    """What doctor says of a line's files so many days from now, by subject."""
    keep_bus_pki(folder, "plant/line", ["127.0.0.1"], ["agents"], NOW)
    files = {"certificate": "gateway.pem", "private_key": "gateway.key.pem", "authority": "authority.pem", **changes}
    network = Network(
        listen="tls/127.0.0.1:7447", names=["agents"], **{key: str(folder / file) for key, file in files.items()}
    )
    found = certificates(network, NOW + timedelta(days=days))
    return {one.subject: (one.verdict, one.measured) for one in found}


def test_doctor_tells_a_month_before_a_certificate_ends(tmp_path: Path) -> None:
    (none,) = certificates(None, NOW)
    assert none.verdict == "OK" and "stays on this machine" in none.measured
    good = looked_at(tmp_path / "a", CERTIFICATE_DAYS - 31)
    assert {verdict for verdict, _ in good.values()} == {"OK"} and len(good) == 4
    soon = looked_at(tmp_path / "b", CERTIFICATE_DAYS - 29)
    assert soon["certificate"][0] == "warning" and "ends in 29 days" in soon["certificate"][1]
    assert soon["authority"][0] == soon["private key"][0] == "OK"
    over = looked_at(tmp_path / "c", CERTIFICATE_DAYS + 2)
    assert over["certificate"][0] == "warning" and "ended 2 days ago" in over["certificate"][1]
    early = looked_at(tmp_path / "d", -1)
    assert early["certificate"][0] == "warning" and "only from" in early["certificate"][1]


def test_doctor_tells_a_certificate_that_another_authority_has_signed(tmp_path: Path) -> None:
    keep_bus_pki(tmp_path / "other", "plant/line", ["127.0.0.1"], ["agents"], NOW)  # of the same names
    mixed = looked_at(tmp_path / "own", 0, authority=str(tmp_path / "other" / "authority.pem"))
    assert mixed["issuer"][0] == "warning" and "is not signed by" in mixed["issuer"][1]
    assert mixed["certificate"][0] == mixed["authority"][0] == mixed["private key"][0] == "OK"
    both = (tmp_path / "own" / "authority.pem").read_bytes() + (tmp_path / "other" / "authority.pem").read_bytes()
    assert issued((tmp_path / "own" / "gateway.pem").read_bytes(), both), "one of several is enough"


@pytest.mark.wires
def test_doctor_tells_what_cannot_be_read_and_what_does_not_fit(tmp_path: Path) -> None:
    lost = looked_at(tmp_path / "a", 0, certificate="lost.pem")
    assert lost["certificate"][0] == lost["private key"][0] == "warning" and "cannot be read" in lost["certificate"][1]
    assert looked_at(tmp_path / "b", 0, certificate="gateway.key.pem")["certificate"][0] == "warning"
    assert "another certificate's" in looked_at(tmp_path / "c", 0, private_key="agents.key.pem")["private key"][1]
    assert looked_at(tmp_path / "d", 0, private_key="agents.pem")["private key"][0] == "warning"
    keep_bus_pki(tmp_path / "e", "plant/line", ["127.0.0.1"], ["agents"], NOW)
    (tmp_path / "e" / "gateway.key.pem").chmod(0o640)
    network = Network(
        listen="tls/127.0.0.1:7447", names=["agents"], certificate=str(tmp_path / "e" / "gateway.pem"),
        private_key=str(tmp_path / "e" / "gateway.key.pem"), authority=str(tmp_path / "e" / "authority.pem"),
    )  # fmt: skip
    assert "mode 640" in list(certificates(network, NOW))[-1].measured

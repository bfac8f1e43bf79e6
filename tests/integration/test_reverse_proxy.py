"""A test of infra/nginx.conf with nginx, a certificate and a studio."""

import re
import shutil
import socket
import subprocess
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import requests
from requests.adapters import HTTPAdapter

CONFIG = Path(__file__).parents[2] / "infra/nginx.conf"
HOST = "studio.example.org"


def find_free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def write_certificate(folder: Path) -> tuple[Path, Path]:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, HOST)])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(HOST)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    paths = folder / "studio.pem", folder / "studio.key"
    paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return paths


class PublicAddress(HTTPAdapter):
    """Connects to a port of this machine, with the name of the public host for TLS and in the Host header."""

    def __init__(self, port: int) -> None:
        self.port = port
        super().__init__()

    def send(self, request, **options):
        request.headers["Host"] = HOST
        request.url = request.url.replace(f"https://{HOST}", f"https://127.0.0.1:{self.port}")
        self.poolmanager.connection_pool_kw |= {"server_hostname": HOST, "assert_hostname": HOST}
        return super().send(request, **options)


def make_session(port: int, certificate: Path) -> requests.Session:
    session = requests.Session()
    session.trust_env = False  # A variable may name other certificates.
    session.verify = str(certificate)
    session.mount(f"https://{HOST}", PublicAddress(port))
    session.headers["x-studio"] = "1"
    return session


def check_public_studio(session: requests.Session, address: str) -> None:
    assert address.startswith(f"https://{HOST}") and "?token=" in address
    assert session.get(f"https://{HOST}/").status_code == 401
    moved = session.get(address, allow_redirects=False)
    assert moved.status_code == 303 and moved.headers["location"] == "/" and "Secure" in moved.headers["set-cookie"]
    assert session.get(f"https://{HOST}/").status_code == 200
    state = session.post(f"https://{HOST}/api/open", json={"scene_id": "given-0"}).json()
    assert state["scene"]["scene_id"] == "given-0"


def test_studio_serves_https(studio_files, cluster, tmp_path):
    from jobs.implementation.serve_studio import serve_studio
    from jobs.serve_studio import Config

    certificate, key = write_certificate(tmp_path)
    token = tmp_path / "token"
    token.write_text("a-token-of-at-least-16-letters\n")
    files = str(studio_files / "model"), (str(studio_files / "tables"),)
    secure = {"tls_certificate": str(certificate), "tls_key": str(key)}
    studio = serve_studio(Config(*files, port=0, token_file=str(token), host_names=(HOST,), **secure))
    try:
        port = int(studio.address.split(":")[2].split("/")[0])
        check_public_studio(make_session(port, certificate), f"https://{HOST}/?{studio.address.split('?')[1]}")
    finally:
        studio.stop()
    with pytest.raises(ValueError, match="--tls-certificate and --tls-key belong together"):
        serve_studio(Config(*files, tls_key=str(key)))
    with pytest.raises(ValueError, match="expected an address such as https"):
        serve_studio(Config(*files, public_url="studio.example.org"))


@pytest.mark.skipif(shutil.which("nginx") is None, reason="nginx is not installed")
def test_nginx_configuration_passes_requests_to_studio(studio_files, cluster, tmp_path):
    from jobs.implementation.serve_studio import serve_studio
    from jobs.serve_studio import Config

    certificate, key = write_certificate(tmp_path)
    port, http_port, own_port = find_free_port(), find_free_port(), find_free_port()
    files = str(studio_files / "model"), (str(studio_files / "tables"),)
    studio = serve_studio(Config(*files, port=own_port, public_url=f"https://{HOST}"))
    text = CONFIG.read_text()
    for old, new in {
        "listen 443 ssl": f"listen 127.0.0.1:{port} ssl",
        "listen 80;": f"listen 127.0.0.1:{http_port};",
        "/etc/ssl/studio.pem": str(certificate),
        "/etc/ssl/studio.key": str(key),
        "127.0.0.1:8600": f"127.0.0.1:{own_port}",
        "/var/log/nginx/studio.log": str(tmp_path / "access.log"),
    }.items():
        assert text.count(old) >= 1
        text = text.replace(old, new)
    (tmp_path / "nginx.conf").write_text(f"pid {tmp_path}/nginx.pid;\nerror_log {tmp_path}/error.log;\n{text}")
    command = ["nginx", "-c", str(tmp_path / "nginx.conf"), "-g", "daemon off;"]
    with subprocess.Popen(command) as proxy:
        try:
            for _ in range(100):
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
                time.sleep(0.05)
            session = make_session(port, certificate)
            check_public_studio(session, studio.address)
            answer = session.get(f"https://{HOST}/api/state")
            assert "max-age" in answer.headers["strict-transport-security"]
            assert answer.headers["referrer-policy"] == "no-referrer"
            plain = requests.get(f"http://127.0.0.1:{http_port}/x", headers={"host": HOST}, allow_redirects=False)
            assert (plain.status_code, plain.headers["location"]) == (301, f"https://{HOST}/x")
            assert session.post(f"https://{HOST}/api/edit", data=b"x" * 300_000).status_code == 413
        finally:
            proxy.terminate()
            studio.stop()
    assert re.search(r'"GET /" 303', (tmp_path / "access.log").read_text())
    assert "token" not in (tmp_path / "access.log").read_text()

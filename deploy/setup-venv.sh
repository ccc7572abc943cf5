#!/bin/sh
# Usage: setup-venv.sh FOLDER - makes the virtual environment from requirements.lock, every package checked by hash.
set -eu
venv=$1
python=
for candidate in ${PYTHON:-} python3.14 python3.13 python3.12 python3.11 python3; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        python=$candidate
        break
    fi
done
[ -n "$python" ] || { echo "r2rgate needs Python 3.11 or newer; set PYTHON=/path/to/python3" >&2; exit 1; }
[ ! -L "$venv" ] || { echo "$venv is a link: it is not touched; remove it, and it is made anew" >&2; exit 1; }
mkdir -p out
echo "setting up $venv with $($python --version) (once, a minute or two)"
"$python" -m venv --clear "$venv" >out/setup.log 2>&1 || {
    cat out/setup.log >&2
    echo "$python cannot make a virtual environment: install its venv module (Debian: apt-get install python3-venv)" >&2
    exit 1
}
pip() {
    "$venv/bin/python" -m pip --disable-pip-version-check --no-input "$@" >>out/setup.log 2>&1 || {
        tail -n 20 out/setup.log >&2
        echo "the packages could not be installed; the whole story is in out/setup.log" >&2
        exit 1
    }
}
pip install --no-compile --require-hashes -r requirements.lock
pip install --no-compile --no-deps --no-build-isolation --editable .
touch "$venv/.ready"

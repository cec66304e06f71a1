# Sourced by scripts/run and scripts/test: makes .venv and installs what is missing.
# By hand on Debian or Ubuntu:
#   apt-get install python3 python3-venv gcc libc6-dev libegl1 libgl1 libusb-1.0-0
#   python3 -m venv .venv && .venv/bin/pip install -e '.[dev]'

say() { printf 'rigkit set-up: %s\n' "$*" >&2; }

as_root() {
    if [ "$(id -u)" = 0 ]; then
        "$@"
    elif command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
        sudo -n "$@"
    else
        return 1
    fi
}

# Install Debian packages, or say exactly what to type.
system_packages() {
    say "installing from the system's packages: $*"
    log=$(mktemp)
    if command -v apt-get >/dev/null 2>&1 &&
        as_root sh -c 'apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"' sh "$@" >"$log" 2>&1; then
        rm -f "$log"
        return 0
    fi
    cat "$log" >&2
    rm -f "$log"
    say "could not install them. As root, type:  apt-get update && apt-get install $*"
    exit 2
}

find_python() {
    for candidate in python3.11 python3 python3.12 python3.13 python; do
        if command -v "$candidate" >/dev/null 2>&1 &&
            "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$candidate"
            return 0
        fi
    done
    return 1
}

# Whether a C program can be compiled and linked with what setup.py will use.
compiles() {
    folder=$(mktemp -d)
    printf '#include <math.h>\n#include <stdlib.h>\nint main(void) { return (int)sqrt(0.0); }\n' >"$folder/a.c"
    ${CC:-$(command -v gcc || command -v cc || echo cc)} "$folder/a.c" -o "$folder/a" -lm 2>/dev/null
    result=$?
    rm -rf "$folder"
    return $result
}

# set_up EXTRAS: a virtual environment with the package and its extras ('' or '[dev]').
set_up() {
    root=$1
    extras=$2
    venv="$root/.venv"
    if ! python=$(find_python); then
        system_packages python3 python3-venv
        python=$(find_python) || { say "needs Python 3.11 or newer; none found on PATH"; exit 2; }
    fi
    if ! "$venv/bin/python" -c 'import pip' >/dev/null 2>&1; then
        say "making $venv"
        if ! "$python" -c 'import venv, ensurepip' >/dev/null 2>&1; then
            system_packages python3-venv
        fi
        rm -rf "$venv"
        "$python" -m venv "$venv"
    fi
    wanted="$extras $(cat "$root/pyproject.toml" "$root/setup.py" "$root/scripts/setup.sh" "$root"/rigkit/kernels/*.[ch] "$root/rigkit/kernels/building.py" | cksum)"
    stamp="$venv/.rigkit-installed"
    # The tests' set-up contains the plain one.
    if ! { [ -x "$venv/bin/rigkit" ] && grep -qxF -e "$wanted" -e "[dev] ${wanted#* }" "$stamp" 2>/dev/null; }; then
        compiles || { say "a C compiler builds the kernels"; system_packages gcc libc6-dev; }
        say "installing Python packages (about 600 MB the first time)"
        "$venv/bin/python" -m pip install --quiet --disable-pip-version-check -e "$root$extras" >&2 ||
            { say "pip could not install the packages; see above (the kernels need a C compiler: gcc or clang)"; exit 2; }
        printf '%s\n' "$wanted" >"$stamp"
    fi
    missing=$("$venv/bin/python" - <<'PY'
import ctypes

needed = {"libEGL.so.1": "libegl1", "libGL.so.1": "libgl1", "libusb-1.0.so.0": "libusb-1.0-0"}
missing = []
for library, package in needed.items():
    try:
        ctypes.CDLL(library)
    except OSError:
        missing.append(package)
print(" ".join(missing))
PY
    )
    if [ -n "$missing" ]; then
        # shellcheck disable=SC2086
        system_packages $missing
    fi
}

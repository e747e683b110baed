#!/bin/sh
# Open3D's wheel needs libraries of the system that a minimal machine lacks. Install them where allowed, else say how.
set -eu

# Shared library, and its package of Debian, of Fedora, and of Arch.
libraries='
libusb-1.0.so.0 libusb-1.0-0 libusb1 libusb
libGL.so.1 libgl1 mesa-libGL libglvnd
libEGL.so.1 libegl1 mesa-libEGL libglvnd
libX11.so.6 libx11-6 libX11 libx11
libidn2.so.0 libidn2-0 libidn2 libidn2
'

# The packages (column 2, 3 or 4) of the libraries that are missing.
missing() {
    echo "$libraries" | while read -r library packages; do
        [ -n "$library" ] || continue
        ldconfig -p 2>/dev/null | grep -qF "$library" && continue
        for directory in /lib /usr/lib /usr/lib64 /usr/local/lib "/usr/lib/$(uname -m)-linux-gnu"; do
            [ -e "$directory/$library" ] && continue 2
        done
        echo "$library $packages" | cut -d' ' -f"$1"
    done | tr '\n' ' '
}

[ "$(uname -s)" = Linux ] || exit 0
[ -n "$(missing 1)" ] || exit 0

if command -v apt-get >/dev/null 2>&1; then
    command="apt-get install --yes $(missing 2)"
    if [ "$(id -u)" -eq 0 ]; then
        echo "Open3D needs system libraries: $command"
        apt-get update --quiet=2 && DEBIAN_FRONTEND=noninteractive $command >/dev/null || true
    elif sudo -n true 2>/dev/null; then
        echo "Open3D needs system libraries: $command"
        sudo -n apt-get update --quiet=2 && sudo -n env DEBIAN_FRONTEND=noninteractive $command >/dev/null || true
    fi
    command="sudo $command"
elif command -v dnf >/dev/null 2>&1; then
    command="sudo dnf install $(missing 3)"
elif command -v pacman >/dev/null 2>&1; then
    command="sudo pacman -S $(missing 4)"
else
    command='(install them with the package manager of this system)'
fi

if [ -n "$(missing 1)" ]; then
    echo "Open3D needs system libraries that are missing ($(missing 1)); install them and try again:" >&2
    echo "    $command" >&2
    exit 1
fi

#!/bin/sh
# Open3D's wheel needs libusb-1.0, which a minimal machine lacks. Install it where that is allowed, else say how.
set -eu

present() {
    ldconfig -p 2>/dev/null | grep -q 'libusb-1\.0\.so\.0' && return 0
    for directory in /lib /usr/lib /usr/lib64 /usr/local/lib "/usr/lib/$(uname -m)-linux-gnu"; do
        [ -e "$directory/libusb-1.0.so.0" ] && return 0
    done
    return 1
}

[ "$(uname -s)" = Linux ] || exit 0
present && exit 0

command='apt-get install --yes libusb-1.0-0'
if command -v apt-get >/dev/null 2>&1; then
    if [ "$(id -u)" -eq 0 ]; then
        echo 'Open3D needs the system library libusb-1.0: installing it'
        apt-get update --quiet=2 && DEBIAN_FRONTEND=noninteractive $command >/dev/null || true
    elif sudo -n true 2>/dev/null; then
        echo 'Open3D needs the system library libusb-1.0: installing it'
        sudo -n apt-get update --quiet=2 && sudo -n env DEBIAN_FRONTEND=noninteractive $command >/dev/null || true
    fi
    command="sudo $command"
elif command -v dnf >/dev/null 2>&1; then
    command='sudo dnf install libusb1'
elif command -v pacman >/dev/null 2>&1; then
    command='sudo pacman -S libusb'
else
    command='(install libusb-1.0 with the package manager of this system)'
fi

if ! present; then
    echo "Open3D needs the system library libusb-1.0, which is missing. Install it and try again:" >&2
    echo "    $command" >&2
    exit 1
fi

#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# README's lines on a bare Debian, as an ordinary user: what a newcomer's machine has, and no more.
#
#   sudo tests/bare_machine.sh DIR [COMMAND...]
#
# DIR/SUITE becomes the root of that machine (debootstrap makes it, once), with the packages that README names
# and an ordinary account; the tree as it stands on disk is copied into the account's home, and README's
# lines are run there, first the tests, then the demo. COMMAND: that is run instead, in a shell.
# The machine has its own processes, /proc, /dev/shm and /tmp; no compiler, no desktop, no /dev/stdout.
# Set by variables:
#   BARE_SUITE     bookworm (default: Python 3.11), trixie (3.13), forky or sid (3.14)
#   BARE_PACKAGES  more packages of Debian, such as "gcc python3-dev"
#   BARE_TIMES     how often the tests are run in a row, default 1
#   BARE_BUSY      how many processes keep a processor busy meanwhile, default 0
#   BARE_MIRROR    where packages come from, default http://deb.debian.org/debian
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root: debootstrap, chroot" >&2; exit 1; }
[ $# -ge 1 ] || { sed -n '3,17s/^# \{0,1\}//p' "$0" >&2; exit 2; }
command -v debootstrap >/dev/null || { echo "debootstrap is missing: apt-get install debootstrap" >&2; exit 1; }
mkdir -p "$1"
directory=$(cd "$1" && pwd)
shift
cd "$(dirname "$0")/.."
suite=${BARE_SUITE:-bookworm}
read -ra more <<<"${BARE_PACKAGES:-}"
machine=$directory/$suite
user=newcomer

if [ ! -e "$machine/etc/shmmap-is-bare" ]; then
  rm -rf "$machine"
  script=/usr/share/debootstrap/scripts/$suite
  [ -e "$script" ] || script=${script%/*}/sid # newer than this debootstrap
  debootstrap --variant=minbase --include=ca-certificates "$suite" "$machine" "${BARE_MIRROR:-http://deb.debian.org/debian}" "$script" \
    >"$machine.log" 2>&1 || { tail -n 5 "$machine.log" >&2; exit 1; }
  chroot "$machine" useradd --create-home --shell /bin/bash "$user"
  touch "$machine/etc/shmmap-is-bare"
fi
# names and certificates are the host's
cp -L /etc/resolv.conf /etc/hosts "$machine/etc/"
[ ! -e /etc/ssl/certs/ca-certificates.crt ] || cp -L /etc/ssl/certs/ca-certificates.crt "$machine/etc/ssl/certs/"

inside() { # run a command on the machine as root, with processes and mounts of its own
  # shellcheck disable=SC2016  # expanded inside
  unshare --mount --pid --ipc --fork --kill-child bash -euc '
    mount -t proc proc "$1/proc"
    mount -t tmpfs -o mode=1777 tmpfs "$1/tmp"
    mkdir -p "$1/dev/shm" "$1/dev/pts"
    mount -t devpts -o newinstance,ptmxmode=0666 devpts "$1/dev/pts"
    ln -sfn pts/ptmx "$1/dev/ptmx"
    mount -t tmpfs -o mode=1777,size=2g tmpfs "$1/dev/shm"
    root=$1; shift
    exec chroot "$root" "$@"
  ' bash "$machine" "$@"
}

rm -f "$machine"/dev/std{in,out,err} # minimal machines lack them
inside sh -euc 'dpkg -s "$@" >/dev/null 2>&1 || { apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"; } >/tmp/apt.log 2>&1 || { cat /tmp/apt.log; exit 1; }' \
  sh git python3-venv "${more[@]}"

clone=$machine/home/$user/shmmap
rm -rf "$clone"
mkdir "$clone"
git ls-files -z --cached --others --exclude-standard | xargs -0 sh -c 'for f; do [ -e "$f" ] && printf "%s\0" "$f"; done' sh \
  | tar --null --files-from=- -cf - | tar -xf - -C "$clone"
git -C "$clone" init -q
git -C "$clone" add -A
git -C "$clone" -c user.name=test -c user.email=test@localhost commit -q -m all
owner=$(stat -c %u:%g "$machine/home/$user")
chown -R "$owner" "$clone"

as_newcomer() { # run a line of a shell in the clone
  local kept=() name
  for name in ${!PIP_*} SSL_CERT_FILE REQUESTS_CA_BUNDLE; do
    [ -z "${!name:-}" ] || kept+=("$name=${!name}")
  done
  inside chroot --userspec="$owner" / env -i HOME="/home/$user" USER="$user" LOGNAME="$user" SHELL=/bin/bash LANG=C.UTF-8 \
    PATH=/usr/local/bin:/usr/bin:/bin "${kept[@]}" bash -euc "cd ~/shmmap; $1"
}

busy=()
for ((n = 0; n < ${BARE_BUSY:-0}; n++)); do
  (while :; do :; done) &
  busy+=($!)
done
trap '[ ${#busy[@]} = 0 ] || kill "${busy[@]}"' EXIT

if [ $# -gt 0 ]; then
  as_newcomer "$*"
  exit
fi
as_newcomer 'python3 --version'
for ((n = 0; n < ${BARE_TIMES:-1}; n++)); do
  line=$(grep -E '^python3 -m venv .*pytest -q$' README.md)
  printf '\n=== %s, time %d\n' "$line" $((n + 1))
  as_newcomer "$line"
done
line=$(grep -E '^python3 -m venv .*shmmap demo$' README.md)
printf '\n=== %s\n' "$line"
as_newcomer "rm -rf .venv; $line"

# shellcheck shell=bash
# Sourced by deploy/demo and tests/check: installs what is missing, by name, and says each step before it runs.

# A plain user's path often lacks the directories of ip and nft; rustup's is set by a login shell only.
export PATH="$PATH:${CARGO_HOME:-$HOME/.cargo}/bin:/usr/sbin:/sbin"

may_install=yes
apt_is_fresh=no

# Prints a command, then runs it.
run() {
    printf '+ %s\n' "$*"
    "$@"
}

# Runs a command as root, or fails where that would have to ask for a password.
as_root() {
    if [[ $(id -u) == 0 ]]; then
        run "$@"
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        run sudo -n "$@"
    else
        return 1
    fi
}

# need COMMAND PACKAGE: succeeds once COMMAND is there; else says what is missing and how to get it.
need() {
    command -v "$1" >/dev/null && return 0
    if [[ $may_install == yes ]] && command -v apt-get >/dev/null; then
        if [[ $apt_is_fresh == no ]] && as_root apt-get update -qq; then
            apt_is_fresh=yes
        fi
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$2" || true
        hash -r
        command -v "$1" >/dev/null && return 0
    fi
    printf 'missing: the command %s (hint: apt-get install %s)\n' "$1" "$2" >&2
    return 1
}

# Succeeds once the pinned Rust toolchain and a C compiler (which crate `ring` needs) are there.
need_rust() {
    need cc build-essential || return 1
    if ! command -v cargo >/dev/null; then
        need rustup rustup || {
            printf 'missing: the Rust toolchain (hint: https://rustup.rs)\n' >&2
            return 1
        }
        run rustup toolchain install "$(sed -n 's/^channel = "\(.*\)"/\1/p' rust-toolchain.toml)" || return 1
    fi
}

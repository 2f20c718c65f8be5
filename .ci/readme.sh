# Sourced by the scripts of this folder: runs a command of the README, which stands in a fenced block after a marker.
readme_block() {
  awk -v marker="<!-- $1 -->" '$0 == marker {found = 1; next} found && /^```/ {if (++fences == 2) exit; next} found {print}' README.md
}
run_block() {
  local line
  line=$(readme_block "$1")
  [ -n "$line" ] || { echo "README.md has no command after <!-- $1 -->" >&2; exit 1; }
  echo "+ $line"
  eval "$line"
}

# SPDX-License-Identifier: MIT
"""Settings of an experiment whose echoes, or their background, come from a store."""

from __future__ import annotations

from pathlib import Path

from sononerf import storage
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError
from sononerf.settings.loading import validate_settings
from sononerf.settings.schema import FILE_SECTIONS, HEAD_SECTIONS, Settings

OWN_KEYS = ("spectrogram.dynamic_range_db",)
"""Keys of these sections that an experiment may choose: they do not describe the echoes."""


def with_store(settings: Settings) -> Settings:
    """Complete the settings by what the store knows, if the echoes come from a store.

    Settings with a scene are left as they are.

    Args:
        settings: As the user gave them. A key that was not given takes the store's value.

    Returns:
        settings: With air, ears, call and analysis of the store.

    Raises:
        IncompatibleError: If the settings contradict the store.
        InputError: If there is no such store, or it does not say how it was recorded.
    """
    if settings.scene is not None or settings.data.store is None:
        return settings
    path = settings.data.store
    known = EnsembleStore.open(path).attributes.get("settings")
    if not isinstance(known, dict) or not all(
        isinstance(known.get(k), dict) for k in HEAD_SECTIONS
    ):
        raise InputError(
            f"{path}: does not state its head (settings of {', '.join(HEAD_SECTIONS)}); "
            "import the recordings again"
        )
    resolved = settings.plain()
    different = []
    for section in HEAD_SECTIONS:
        # The store's own values are checked like a file's; a newer key takes its default.
        given = getattr(settings, section)
        for key in given.model_fields_set:
            name = f"{section}.{key}"
            if name in OWN_KEYS:
                known[section][key] = resolved[section][key]
            elif key in known[section] and known[section][key] != resolved[section][key]:
                different.append(
                    f"{name}: found {resolved[section][key]}, the store has {known[section][key]}"
                )
        resolved[section] = known[section]
    if different:
        raise IncompatibleError(
            f"{path}: the settings contradict the store; leave these keys out: "
            + "; ".join(sorted(different))
        )
    return with_attached(validate_settings(resolved, settings.source or str(path)), path)


def complete_store(path: Path) -> EnsembleStore:
    """Open a store of which nothing is missing.

    Raises:
        InputError: If a pose is missing, or the store is not finished.
    """
    store = EnsembleStore.open(path)
    missing = store.missing()
    if missing or "reference" not in store.attributes:
        what = f"{len(missing)} poses are missing" if missing else "it is not finished"
        raise InputError(f"{path}: {what}; give the same simulate or import command again")
    return store


FOLDER = "attached"
"""Where the copies are, in the folder of a run or a store."""


def attach(settings: Settings, folder: Path) -> None:
    """Copy the files that settings name into a folder, if they are not there yet.

    Args:
        settings: Of the run or the store.
        folder: Of the run or the store.

    Raises:
        InputError: If a file cannot be read.
        StorageError: If a copy cannot be written.
    """
    for section in FILE_SECTIONS:
        file = getattr(settings, section).file
        if file is None or (copy := _copy_of(file, section, folder)).is_file():
            continue
        try:
            content = file.read_bytes()
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
        storage.make_folder(copy.parent)
        storage.commit_bytes(copy, content)


def with_attached(settings: Settings, folder: Path) -> Settings:
    """Return the settings with the paths of copies in a folder, where there are copies."""
    found = {}
    for section in FILE_SECTIONS:
        own = getattr(settings, section)
        if own.file is not None and (copy := _copy_of(own.file, section, folder)).is_file():
            found[section] = own.model_copy(update={"file": copy})
    return settings.model_copy(update=found) if found else settings


def _copy_of(file: Path, section: str, folder: Path) -> Path:
    return folder / FOLDER / f"{section}{file.suffix}"

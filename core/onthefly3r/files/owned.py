"""An output folder that has one owner: only what the owner wrote and listed is ever replaced or removed in it."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError, StorageError
from .atomic import replace_file, sync_file, sync_folder
from .lock import LOCK_NAME, FolderLock
from .ownership import STAMP_NAME, WORK, Listed, Move, Publication, Stamp, fingerprint, read_stamp
from .path_length import require_short
from .room import require_access, require_room, storage_error, storage_errors

if TYPE_CHECKING:
    from typing_extensions import Self

LITTER = {LOCK_NAME, ".DS_Store", "Thumbs.db", "desktop.ini", ".directory"}  # of file managers, or of a killed start


class OwnedFolder:
    """A folder that a verb writes into, claimed by `claim`.

    A stamp lists every file that we wrote. New files are made in a scratch folder below `work`, and `publish` swaps
    them in: all or none, also when a power cut comes between. A file that is not listed, or that somebody changed
    since, is never replaced or removed.
    """

    def __init__(self, path: Path, stamp: Stamp) -> None:
        """For `claim` and subclasses; `path` is locked by this process."""
        self.path = path
        self.stamp = stamp

    @classmethod
    @contextlib.contextmanager
    def claim(
        cls, path: Path, verb: str, *, names: Iterable[str] = (), need_bytes: int = 0, guest: bool = False
    ) -> Iterator[Self]:
        """Own a folder for the block; everything is checked before the first write.

        Args:
            path: the folder; it is made.
            verb: who asks, for the words to a second process.
            names: files that the verb may write, relative to the folder.
            need_bytes: room that the disk must have.
            guest: whether a folder that holds other things will do, as long as `names` are free in it.

        Raises:
            InputError: the folder is a file, holds other things, or one of `names` is taken; nothing was changed.
            BusyError: another process works in the folder.
            StorageError: the folder cannot be written, or the disk is too full.
        """
        path = Path(path)
        before = cls.require(path, names, guest)
        require_room(path, need_bytes, f"'{verb}'")
        with storage_errors(path):
            made = _make_folder(path)
        lock = FolderLock(path)
        try:
            with storage_errors(path):
                lock.acquire(verb)
                folder = cls(path, cls._look(path, (), guest) or before or Stamp())
                folder._begin()
                require_free(path, folder.stamp, names)
            try:
                yield folder
            finally:
                folder._end()
        finally:
            lock.release()
            _remove_if_empty(made)

    @classmethod
    def require(cls, path: Path, names: Iterable[str] = (), guest: bool = False) -> Stamp | None:
        """Raise as `claim` does for what can be told without a write; return the folder's stamp."""
        require_short(Path(path))
        stamp = cls._look(Path(path), names, guest)
        require_access(Path(path))
        return stamp

    @classmethod
    def _look(cls, path: Path, names: Iterable[str], guest: bool) -> Stamp | None:
        """Check without writing that the folder may be claimed; return its stamp, None without one."""
        if os.path.lexists(path) and not path.is_dir():
            raise InputError(f"{path}: is a file; name a folder for the results")
        try:
            stamp = read_stamp(path)
            held = sorted(item.name for item in path.iterdir() if item.name not in LITTER) if path.exists() else []
        except OSError as error:
            raise storage_error(error, path) from error
        if stamp is None and held and not guest:
            raise InputError(f"{path}: is not empty (it holds {held[0]}) {cls._not_ours(path)}")
        work = path / WORK
        if os.path.lexists(work) and (work.is_symlink() or not work.is_dir()):
            raise InputError(f"{work}: is no folder of ours, but a file or a link; remove it or name another folder")
        if stamp is None or stamp.publication is None:  # else they are being replaced
            require_free(path, stamp or Stamp(), names)
        return stamp

    @classmethod
    def _not_ours(cls, path: Path) -> str:
        """Return the rest of the sentence that refuses a folder without our stamp."""
        return "and no earlier result; name another folder"

    # ------------------------------------------------------------------ writing

    @contextlib.contextmanager
    def scratch(self) -> Iterator[Path]:
        """Yield a new folder below `work` for files under way; it is removed afterwards, with what is left in it."""
        name = self.new_scratch("new")
        try:
            yield self.path / name
        finally:
            if self.stamp.publication is None:  # else the next claim ends it from what is there
                with contextlib.suppress(OSError):  # swept by the next claim
                    self.drop_scratch(name)

    def new_scratch(self, kind: str) -> str:
        """Make a listed folder with a random name below `work`; return the name."""
        return self.make_scratch(f"{WORK}/{kind}-{secrets.token_hex(8)}")

    def make_scratch(self, name: str) -> str:
        """Make a scratch folder and list it; return its name."""
        self.stamp.scratch.append(name)
        self.stamp.write(self.path)  # before it is there, so that no folder is left that nobody knows
        (self.path / name).mkdir(parents=True)
        return name

    def drop_scratch(self, name: str) -> None:
        """Remove a scratch folder and take it off the list; a link in its place is only taken off the list."""
        place = self.path / name
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place)
        self.stamp.scratch.remove(name)
        self.stamp.write(self.path)

    def publish(self, made: Path, group: str, clears: Iterable[str] = ()) -> None:
        """Swap in all files below `made`, a scratch folder; what the group held before and is not among them goes.

        The groups that it `clears` go with it.

        Raises:
            InputError: a name is taken by a file that is not ours; nothing was changed.
            StorageError: the disk or another program refused; everything is as it was.
        """
        with storage_errors(self.path):
            names = relative_files(made)
            require_free(self.path, self.stamp, names)
            listed = {name: Listed(group, fingerprint(made / name)) for name in names}
            sources = {name: (made / name).relative_to(self.path).as_posix() for name in names}
            self._swap_in({**{other: {} for other in clears}, group: listed}, sources)

    def _swap_in(self, groups: Mapping[str, Mapping[str, Listed]], sources: Mapping[str, str]) -> None:
        """Replace whole groups of listed files at once; `sources` says where each new file is now, by its name."""
        new = {name: item for files in groups.values() for name, item in files.items()}
        left = {name: item for name, item in self.stamp.files.items() if item.group not in groups and name not in new}
        gone = [
            name
            for name, item in self.stamp.files.items()
            if name not in new and name not in left and is_ours(self.path / name, item)
        ]
        for source in sources.values():
            sync_file(self.path / source)
        for folder in {(self.path / source).parent for source in sources.values()}:
            sync_folder(folder)
        moves = [*(Move(name) for name in gone), *(Move(name, source) for name, source in sources.items())]
        backup = self.new_scratch("old")
        self.stamp.publication = Publication(tuple(moves), {**left, **new}, backup)
        try:
            self.stamp.write(self.path)
        except OSError:
            self.stamp.publication = None
            raise
        self._complete(undo=True)

    def _complete(self, undo: bool) -> None:
        """Do the moves of the publication that the stamp tells of, those that were done before left out."""
        publication = self.stamp.publication
        if publication is None:
            return
        backup, done = self.path / publication.backup, []
        try:
            for number, move in enumerate(publication.moves):
                target = self.path / move.target
                source = None if move.source is None else self.path / move.source
                if source is not None and not os.path.lexists(source):
                    continue  # done before a power cut
                if not undo and not is_ours(target, self.stamp.files.get(move.target)):
                    if source is None:
                        continue
                    require_free(self.path, self.stamp, [move.target])
                if os.path.lexists(target):
                    kept = backup / f"{number:06d}"
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    replace_file(target, kept)
                    done.append((kept, target))
                if source is not None:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    replace_file(source, target)
                    done.append((target, source))
        except OSError as error:
            if undo:
                for now, before in reversed(done):
                    replace_file(now, before)
                self.stamp.publication = None
                self.drop_scratch(publication.backup)
            raise StorageError(
                f"{error.filename2 or error.filename}: cannot be replaced ({error.strerror}); close the program that "
                "shows it, and run the command again; the files are as they were"
            ) from error
        for folder in sorted({(self.path / move.target).parent for move in publication.moves}):
            if folder.is_dir():
                sync_folder(folder)
                _remove_empty_folders(folder, self.path)
        self.stamp.files, self.stamp.publication = dict(publication.files), None
        self.stamp.write(self.path)
        if publication.backup in self.stamp.scratch:
            self.drop_scratch(publication.backup)

    # ------------------------------------------------------------------ begin and end

    def _begin(self) -> None:
        """End what a killed process left half done, and sweep what it left lying about."""
        self.stamp.write(self.path)
        self._complete(undo=False)
        for name in [name for name in self.stamp.scratch if not self._is_kept(name)]:
            self.drop_scratch(name)

    def _is_kept(self, scratch: str) -> bool:
        """Return whether a scratch folder outlives the process that made it."""
        return False

    def _end(self) -> None:
        """Leave no trace in a folder that got no file."""
        with contextlib.suppress(OSError):
            _remove_empty_folders(self.path / WORK, self.path)
            stamp = self.stamp
            if not stamp.files and not stamp.scratch and not stamp.map_open and stamp.publication is None:
                (self.path / STAMP_NAME).unlink()


def relative_files(folder: Path) -> list[str]:
    """Return all files below a folder, relative to it, with slashes."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())


def is_ours(path: Path, listed: Listed | None) -> bool:
    """Return whether a file is the one that was listed, unchanged; a file that is gone is."""
    if listed is None:
        return not os.path.lexists(path)
    if path.is_symlink() or path.is_dir():
        return False
    return not path.exists() or not listed.fingerprint or fingerprint(path) == listed.fingerprint


def require_free(folder: Path, stamp: Stamp, names: Iterable[str]) -> None:
    """Raise `InputError` for the first name that is taken by a file which is not ours, or not as we wrote it."""
    for name in names:
        if not is_ours(folder / name, stamp.files.get(name)):
            why = "was changed since it was written" if name in stamp.files else "was not written by this program"
            raise InputError(f"{folder / name}: {why}; move it away, or name another folder")


def _make_folder(path: Path) -> list[Path]:
    """Make a folder and those above it; return the ones that were not there, the lowest first."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    return missing


def _remove_if_empty(folders: Iterable[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def _remove_empty_folders(folder: Path, top: Path) -> None:
    """Remove a folder and those above it up to, but without, `top`, as far as they are empty."""
    while folder != top and top in folder.parents and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent

"""Operations on log files: information, editing, and export; begin with `information`."""

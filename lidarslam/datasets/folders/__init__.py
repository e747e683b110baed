"""Folders of scan files."""

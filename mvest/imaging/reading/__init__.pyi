from .reader import read_volume as read_volume

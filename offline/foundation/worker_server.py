"""Imported by the server of worker processes alone, before all else, so that it ends quickly."""

from groundsbot.offline.foundation.process_start import end_quickly

end_quickly()

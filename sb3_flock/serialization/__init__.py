"""Files: policies and configs saved, loaded without running code from them, and migrated from earlier formats."""
